"""The way from record to record of an MCAP file without a whole index, past what is damaged. No message is read here.

A length that is damaged would lead anywhere. So a record is believed if what is in it agrees with its length, or if
another one begins where it ends; else the next chunk that is whole is searched, and what lies between is said.
"""

import os
import re
import struct
from collections.abc import Iterator
from io import BytesIO
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema, Statistics

from fleet.recording.reading.mcap_chunk import BROKEN, ChunkPart, Damage, named, read
from fleet.recording.reading.mcap_index import HEAD, LIMIT

MAGIC: Final = b"\x89MCAP0\r\n"
_HOLDS_MESSAGES: Final = (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, size, checksum, length of the compression's name
_LONGEST_NAME: Final = 16
_LOOK: Final = HEAD.size + _CHUNK.size + _LONGEST_NAME + 8
_INDEX: Final = struct.Struct("<HI")  # channel, length of the entries
_INDEX_ENTRY: Final = 16
_FIXED: Final = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_EXACT: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
}
_PRIVATE: Final = 0x80
# The head of a chunk that is no longer than LIMIT.
_MAY_BE_CHUNK: Final = re.compile(rb"(?=\x06[\s\S]{3}[\x00-\x05]\x00{4})")
_MAY_BE_SIZE: Final = 9
_BLOCK: Final = 2**20
_PATIENCE: Final = 4
"""What looks like a chunk and is none costs its length: so many times the file's size are spent on it."""


class RecordScanner:
    """One file that is open; what is wrong with it is in `damage`."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = file.seek(0, os.SEEK_END)
        self._spent = 0
        self._known: tuple[int, int | None] | None = None
        """From an offset on the next whole chunk is there, or nowhere."""
        self.damage: list[Damage] = []
        self.cut = False
        """Whether it stops before its end."""

    def pieces(self) -> Iterator[ChunkPart]:
        """What holds messages, in order."""
        size, at = self._size, len(MAGIC)
        in_data, chunks = True, False
        while at < size:
            head = read(self._file, at, HEAD.size)
            if len(head) < HEAD.size:
                self._say(at, "the record there is cut")
                return
            opcode, length = HEAD.unpack(head)
            if not self._believed(at, opcode, length, chunks=chunks):
                found = self.chunk_from(at + 1)
                if found is not None:
                    self._say(at, f"no whole record begins there, {found - at} bytes are passed over")
                    at = found
                    continue
                if words := self._hopeless(at, opcode, length):
                    self._say(at, words)
                    return
            if opcode == Opcode.FOOTER:
                self._end(at + HEAD.size + length)
                return
            in_data = in_data and opcode != Opcode.DATA_END
            if opcode == Opcode.CHUNK or (in_data and opcode in _HOLDS_MESSAGES):
                chunks = chunks or opcode == Opcode.CHUNK
                if length > LIMIT:
                    self._say(at, f"the {named(opcode)} there has {length} bytes: no more than {LIMIT} are read")
                else:
                    yield ChunkPart(at, opcode, read(self._file, at + HEAD.size, length))
            at += HEAD.size + length
        self._say(at, "it stops there")

    def chunk_from(self, start: int) -> int | None:
        """Where the next chunk begins that is whole, not before `start`; None: there is none."""
        if self._known is not None and self._known[0] <= start and (self._known[1] is None or self._known[1] >= start):
            return self._known[1]
        found = next((at for at in self._candidates(start) if self._whole(at)), None)
        self._known = start, found
        return found

    def _candidates(self, start: int) -> Iterator[int]:
        while start < self._size:
            block = read(self._file, start, _BLOCK + _MAY_BE_SIZE - 1)
            for match in _MAY_BE_CHUNK.finditer(block):
                at = start + match.start()
                if self._agrees(at, *HEAD.unpack_from(block, match.start())):
                    yield at
                if self._spent > _PATIENCE * self._size:
                    return
            start += _BLOCK

    def _whole(self, at: int) -> bool:
        _, length = HEAD.unpack(read(self._file, at, HEAD.size))
        if length > LIMIT or at + HEAD.size + length > self._size:
            return False
        if ChunkPart(at, Opcode.CHUNK, read(self._file, at + HEAD.size, length)).whole:
            return True
        self._spent += length
        return False

    def _believed(self, at: int, opcode: int, length: int, *, chunks: bool) -> bool:
        """Whether a record's length leads to the next."""
        end = at + HEAD.size + length
        if not opcode or end > self._size:
            return False
        if self._agrees(at, opcode, length):
            return opcode != Opcode.CHUNK or length > LIMIT or self._begins(end) or self._whole(at)
        # Nobody writes messages both into chunks and between them: it was something else once.
        if opcode in (Opcode.CHUNK, *_FIXED) or (opcode == Opcode.MESSAGE and chunks) or not self._begins(end):
            return False
        passed = self.chunk_from(at + 1)
        return passed is None or passed >= end

    def _agrees(self, at: int, opcode: int, length: int) -> bool:
        """Whether what a record says in itself is what its head says; False also where it says nothing."""
        if opcode in _FIXED:
            return length == _FIXED[Opcode(opcode)]
        if opcode == Opcode.CHUNK:
            body = read(self._file, at + HEAD.size, _LOOK - HEAD.size)
            if len(body) < _CHUNK.size:
                return False
            name = _CHUNK.unpack_from(body)[4]
            if name > _LONGEST_NAME or len(body) < _CHUNK.size + name + 8:
                return False
            (data,) = struct.unpack_from("<Q", body, _CHUNK.size + name)
            return bool(length == _CHUNK.size + name + 8 + data)
        if opcode == Opcode.MESSAGE_INDEX:
            body = read(self._file, at + HEAD.size, _INDEX.size)
            entries = _INDEX.unpack(body)[1] if len(body) == _INDEX.size else 1
            return bool(length == _INDEX.size + entries and not entries % _INDEX_ENTRY)
        if opcode not in _EXACT or length > min(LIMIT, self._size - at):
            return False
        stream = BytesIO(read(self._file, at + HEAD.size, length))
        try:
            _EXACT[opcode].read(ReadDataStream(stream))
        except BROKEN:
            return False
        return bool(stream.tell() == length)

    def _begins(self, at: int) -> bool:
        """Whether a record may begin there, or the file ends."""
        head = read(self._file, at, HEAD.size)
        if len(head) < HEAD.size:
            return not head or 0 < head[0] <= Opcode.DATA_END
        opcode, length = HEAD.unpack(head)
        if opcode in _FIXED or opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            return self._agrees(at, opcode, length)
        known = 0 < opcode <= Opcode.DATA_END or opcode >= _PRIVATE
        return bool(known and at + HEAD.size + length <= self._size)

    def _hopeless(self, at: int, opcode: int, length: int) -> str:
        """Why nothing from there on is read; empty: what the head says is all there is to go by."""
        left = self._size - at - HEAD.size
        if length > left and self._agrees(at, opcode, length):
            return f"the {named(opcode)} there should have {length} bytes, {left} are there"
        if not opcode or length > left:
            return f"no record begins there, and the last {self._size - at} bytes are not read"
        return ""

    def _end(self, at: int) -> None:
        """What follows the footer."""
        after = self._size - at - len(MAGIC)
        self.cut = after < 0
        if self.cut:
            self._say(at, "it stops there")
        elif after:
            self._say(self._size - after, f"{after} bytes follow the end")
        elif read(self._file, at, len(MAGIC)) != MAGIC:
            self._say(at, "the magic bytes of the end are damaged")

    def _say(self, at: int, words: str) -> None:
        self.damage.append(Damage(at, words))
