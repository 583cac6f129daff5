"""Scans an MCAP file that has no valid index, record by record and past damage. Reads no message.

A damaged length could lead anywhere. So the scan trusts a record only if another record follows it and no intact chunk
lies inside it. An intact chunk, and a message index whose lengths agree, are trusted even if a damaged record follows.
Otherwise the scan reports the damage and continues at the next intact chunk.
"""

import os
import re
import struct
from collections.abc import Iterator
from typing import IO, Final

from mcap.opcode import Opcode

from fleet.recording.reading.mcap_chunk import ChunkPart, Damage, named, read
from fleet.recording.reading.mcap_index import HEAD, MAX_RECORD_BYTES

MAGIC: Final = b"\x89MCAP0\r\n"
_HOLDS_MESSAGES: Final = (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_EXTRAS: Final = (Opcode.ATTACHMENT, Opcode.METADATA)
_FIXED_LENGTHS: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_PRIVATE: Final = 0x80
"""First opcode for records of other programs."""
# First and last log time, size, checksum, length of the compression's name.
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_MAX_COMPRESSION_NAME: Final = 16
_MESSAGE_INDEX_HEAD: Final = struct.Struct("<HI")  # channel, length of the entries
# The head of a chunk of less than 96 MiB, which covers all chunks of up to MAX_RECORD_BYTES.
_CANDIDATE: Final = re.compile(rb"(?=\x06[\s\S]{3}[\x00-\x05]\x00{4})")
_BLOCK: Final = 2**20
_MAX_REREADS: Final = 4
"""Maximum number of bytes to read for false candidates, as a multiple of the file size."""


class RecordScanner:
    """Scanner of one open file. `damage` lists the damage found so far."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = file.seek(0, os.SEEK_END)
        self._reread = 0
        self._next_chunk: tuple[int, int | None] | None = None
        """Result of the last search: its start, and the next intact chunk from there."""
        self.damage: list[Damage] = []
        self.cut = True
        """True if the end of the file is missing: no footer was found so far, or the file ends within the footer."""

    def parts(self, *, extras: bool = False) -> Iterator[ChunkPart]:
        """Yield the records that contain messages or describe channels, in order.

        With `extras`, yield the attachments and metadata instead.
        """
        wanted = _EXTRAS if extras else _HOLDS_MESSAGES
        size, at = self._size, len(MAGIC)
        in_data, chunks = True, False
        while at < size:
            head = read(self._file, at, HEAD.size)
            if len(head) < HEAD.size:
                self._report(at, "the record there is cut")
                return
            opcode, length = HEAD.unpack(head)
            end = at + HEAD.size + length
            if not self._is_trusted(at, opcode, length, chunks=chunks):
                found = self.chunk_from(at + 1)
                if found is not None:
                    self._report(at, f"no whole record begins there, {found - at} bytes are passed over")
                    at = found
                    continue
                if opcode and end > size and length <= MAX_RECORD_BYTES:
                    left = size - at - HEAD.size
                    self._report(at, f"the {named(opcode)} there should have {length} bytes, {left} are there")
                    return
                if not opcode or end > size:
                    self._report(at, f"no record begins there, and the last {size - at} bytes are not read")
                    return
            if opcode == Opcode.FOOTER:
                self._check_end(end)
                return
            in_data = in_data and opcode != Opcode.DATA_END
            chunks = chunks or opcode == Opcode.CHUNK
            if opcode in wanted and (in_data or opcode == Opcode.CHUNK):
                if length > MAX_RECORD_BYTES:
                    self._report(
                        at, f"the {named(opcode)} there has {length} bytes, more than the limit of {MAX_RECORD_BYTES}"
                    )
                else:
                    yield ChunkPart(at, opcode, read(self._file, at + HEAD.size, length))
            at = end
        self._report(at, "it stops there")

    def chunk_from(self, start: int) -> int | None:
        """Return the offset of the first intact chunk at or after `start`, or None if not found."""
        if self._next_chunk is not None:
            searched, found = self._next_chunk
            if searched <= start and (found is None or found >= start):
                return found
        found = next((at for at in self._candidates(start) if self._is_intact(at)), None)
        self._next_chunk = start, found
        return found

    def _candidates(self, start: int) -> Iterator[int]:
        while start < self._size:
            block = read(self._file, start, _BLOCK + HEAD.size - 1)
            for match in _CANDIDATE.finditer(block):
                if self._is_chunk_head(start + match.start(), HEAD.unpack_from(block, match.start())[1]):
                    yield start + match.start()
                # In a file full of false heads, each one could cost a read of the whole file.
                if self._reread > _MAX_REREADS * self._size:
                    return
            start += _BLOCK

    def _is_intact(self, at: int) -> bool:
        """Return True if every record of this chunk can be read."""
        _, length = HEAD.unpack(read(self._file, at, HEAD.size))
        if length > MAX_RECORD_BYTES or at + HEAD.size + length > self._size:
            return False
        if ChunkPart(at, Opcode.CHUNK, read(self._file, at + HEAD.size, length)).is_intact:
            return True
        self._reread += length
        return False

    def _is_trusted(self, at: int, opcode: int, length: int, *, chunks: bool) -> bool:
        """Return True if the length of a record leads to the next record."""
        end = at + HEAD.size + length
        if not self._is_head(at, opcode, length):
            return False
        if opcode == Opcode.CHUNK:
            return length > MAX_RECORD_BYTES or self._begins(end) or self._is_intact(at)
        # If the length of the entries of an index agrees, trust the record even if a damaged one follows.
        if opcode == Opcode.MESSAGE_INDEX:
            body = read(self._file, at + HEAD.size, _MESSAGE_INDEX_HEAD.size)
            return (
                len(body) == _MESSAGE_INDEX_HEAD.size
                and length == _MESSAGE_INDEX_HEAD.size + _MESSAGE_INDEX_HEAD.unpack(body)[1]
            )
        # No writer puts messages both into chunks and between them, so this opcode is damaged.
        if (opcode == Opcode.MESSAGE and chunks) or not self._begins(end):
            return False
        inside = self.chunk_from(at + 1)
        return inside is None or inside >= end

    def _begins(self, at: int) -> bool:
        """Return True if a record may begin there, or if the file ends there."""
        head = read(self._file, at, HEAD.size)
        if len(head) < HEAD.size:
            return not head or 0 < head[0] <= Opcode.DATA_END
        return self._is_head(at, *HEAD.unpack(head))

    def _is_head(self, at: int, opcode: int, length: int) -> bool:
        """Return True if a record may have this opcode and length."""
        if opcode == Opcode.CHUNK and not self._is_chunk_head(at, length):
            return False
        known = 0 < opcode <= Opcode.DATA_END or opcode >= _PRIVATE
        return known and _FIXED_LENGTHS.get(opcode, length) == length and at + HEAD.size + length <= self._size

    def _is_chunk_head(self, at: int, length: int) -> bool:
        """Return True if the lengths inside a chunk add up to the length of its record."""
        body = read(self._file, at + HEAD.size, _CHUNK_HEAD.size + _MAX_COMPRESSION_NAME + 8)
        if len(body) < _CHUNK_HEAD.size:
            return False
        name = _CHUNK_HEAD.unpack_from(body)[4]
        if name > _MAX_COMPRESSION_NAME or len(body) < _CHUNK_HEAD.size + name + 8:
            return False
        (data,) = struct.unpack_from("<Q", body, _CHUNK_HEAD.size + name)
        return bool(length == _CHUNK_HEAD.size + name + 8 + data)

    def _check_end(self, at: int) -> None:
        """Check the bytes after the footer."""
        after = self._size - at - len(MAGIC)
        self.cut = after < 0
        if self.cut:
            self._report(at, "it stops there")
        elif after:
            self._report(self._size - after, f"{after} bytes follow the end")
        elif read(self._file, at, len(MAGIC)) != MAGIC:
            self._report(at, "the magic bytes of the end are damaged")

    def _report(self, at: int, words: str) -> None:
        self.damage.append(Damage(at, words))
