"""What is whole of one MCAP file, and where and why the rest is not. No sessions here, and nothing is repaired.

The mcap library reads every record, and checks and takes apart every chunk. Only the way from record to record is our
own, because the library's is made for whole files: it allocates what a damaged length says, reads to the end for a
negative one, gives up at the first damage without saying where, and takes eight times as long (1.0 instead of 0.12 us
a message) because it reads each message's index. A file with an end is not walked at all: its index says where chunks
are, so that a damaged one hides no other.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import IO, Final

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Message, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary

MAGIC: Final = b"\x89MCAP0\r\n"
LIMIT: Final = 16 * 2**20
"""No record, and no chunk when uncompressed, is read if it is larger: 16 times the chunks that we write."""

_HEAD: Final = struct.Struct("<BQ")  # opcode, length
_FOOTER_SIZE: Final = _HEAD.size + 20
_DATA_END_SIZE: Final = _HEAD.size + 4
_BLOCK: Final = 2**20
_HOLDS_MESSAGES: Final = (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
# The ways in which the library, and what it decompresses with, say that bytes are not what they should be.
_BROKEN: Final = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)


class NotMcap(Exception):
    """A file of another kind, or none; its text says why."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is wrong with a file."""

    at: int
    """Offset in bytes of what could not be read."""
    words: str

    def __str__(self) -> str:
        return f"byte {self.at}: {self.words}"


@dataclass(frozen=True, slots=True)
class _Piece:
    """A chunk, or in a file without chunks one record, as bytes."""

    at: int
    opcode: int
    body: bytes
    span: str = ""
    """From when to when it has messages; empty where the index does not say so."""

    def chunk(self) -> Chunk:
        """Its records, uncompressed, not yet checked; raises one of _BROKEN."""
        if self.opcode != Opcode.CHUNK:
            return Chunk("", _HEAD.pack(self.opcode, len(self.body)) + self.body, 0, 0, 0, _HEAD.size + len(self.body))
        chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(self.body)))
        size = chunk.uncompressed_size
        if size > LIMIT:
            raise ValueError(f"says that it has {size} bytes: no more than {LIMIT} are read")
        # One byte more than it should have: to see one that has more, without making room for all of it.
        data: bytes
        match chunk.compression:
            case "":
                return chunk
            case "zstd":
                data = zstandard.ZstdDecompressor(max_window_size=LIMIT).stream_reader(chunk.data).read(size + 1)
            case "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
            case other:
                raise ValueError(f"has a compression that is not known: {other[:20]!r}")
        if len(data) != size:
            raise EndOfFile
        plain: Chunk = replace(chunk, compression="", data=data)
        return plain

    def lost(self, error: Exception) -> Damage:
        """Why this was not read."""
        match error:
            case CRCValidationError():
                words = "fails its checksum"
            case ValueError() if not isinstance(error, UnicodeError):
                words = str(error)
            case _:
                words = "cannot be taken apart"
        return Damage(self.at, f"the {_named(self.opcode)} there {words}{self.span}")


class Salvage:
    """One file; raises NotMcap. What is wrong is in `damage`, as far as `check` or `messages` have looked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[Damage] = []
        self.cut = False
        """Whether it has no end: whoever wrote it was killed, or is still writing."""
        if not path.is_file():
            raise NotMcap("is not a regular file" if path.exists() else "is missing")
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
        except OSError as error:
            raise NotMcap(f"cannot be read: {error.strerror}") from None
        if not head:
            raise NotMcap("is empty: the recorder ended before it wrote anything")
        if head != MAGIC:
            early = MAGIC.startswith(head)
            raise NotMcap(
                f"is cut at byte {len(head)}, before anything was recorded"
                if early
                else "is not an MCAP file: it does not begin with MCAP's magic bytes"
            )

    @property
    def words(self) -> str:
        """What is wrong, on one line; empty if nothing is."""
        if not self.damage:
            return ""
        kind = "is cut (the recorder was killed or is still at work)" if self.cut else "is damaged"
        more = f" and in {len(self.damage) - 3} other places" if len(self.damage) > 3 else ""
        return f"{kind}: {'; '.join(str(damage) for damage in self.damage[:3])}{more}"

    def check(self) -> None:
        """Hold every checksum against what it is for; no message is taken apart."""
        self._begin()
        try:
            with self.path.open("rb") as file:
                footer, summary = self._index(file)
                for piece in self._pieces(file, summary):
                    try:
                        get_chunk_data_stream(piece.chunk(), validate_crc=True)
                    except _BROKEN as error:
                        self.damage.append(piece.lost(error))
                if footer is not None and not self.damage:
                    self._check_data(file, footer)
        except OSError as error:
            self._unreadable(error)

    def messages(self) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Every message that is whole, in the order of writing. Never holds more than one chunk."""
        self._begin()
        try:
            with self.path.open("rb") as file:
                _, summary = self._index(file)
                channels = {} if summary is None else dict(summary.channels)
                schemas: dict[int, Schema | None] = {0: None} if summary is None else {0: None, **summary.schemas}
                strays: list[int] = []
                for piece in self._pieces(file, summary):
                    try:
                        records = breakup_chunk(piece.chunk(), validate_crc=True)
                    except _BROKEN as error:
                        self.damage.append(piece.lost(error))
                        continue
                    for record in records:
                        if isinstance(record, Message):
                            channel = channels.get(record.channel_id)
                            if channel is None or channel.schema_id not in schemas:
                                strays.append(piece.at)
                            else:
                                yield schemas[channel.schema_id], channel, record
                        elif isinstance(record, Channel):
                            channels[record.id] = record
                        elif isinstance(record, Schema):
                            schemas[record.id] = record
                if strays:
                    words = f"{len(strays)} messages from there on are of channels that were described in what is lost"
                    self.damage.append(Damage(strays[0], words))
        except OSError as error:
            self._unreadable(error)

    def _begin(self) -> None:
        self.damage, self.cut = [], False

    def _unreadable(self, error: OSError) -> None:
        self.damage.append(Damage(0, f"it cannot be read: {error.strerror}"))

    def _index(self, file: IO[bytes]) -> tuple[Footer | None, Summary | None]:
        """What stands at the end of a file, if its checksum says that it is whole."""
        size = file.seek(0, os.SEEK_END)
        at = size - _FOOTER_SIZE - len(MAGIC)
        tail = _read(file, max(at, 0), _FOOTER_SIZE + len(MAGIC))
        if at < len(MAGIC) or not tail.endswith(MAGIC):
            self.cut = True
            return None, None
        if _HEAD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_SIZE - _HEAD.size):
            self.damage.append(Damage(at, "there is no footer"))
            return None, None
        footer = Footer.read(ReadDataStream(BytesIO(tail[_HEAD.size :])))
        if not footer.summary_start or not footer.summary_crc:
            return None, None  # somebody else's file: without an index, or with one that cannot be checked
        if not len(MAGIC) + _DATA_END_SIZE <= footer.summary_start <= at:
            self.damage.append(Damage(at, "the footer says that the index is where it cannot be"))
            return None, None
        if _checksum(file, footer.summary_start, at + _FOOTER_SIZE - 4) != footer.summary_crc:
            self.damage.append(Damage(footer.summary_start, "the index there fails its checksum"))
            return None, None
        try:
            file.seek(0)
            return footer, SeekingReader(file, record_size_limit=LIMIT).get_summary()
        except _BROKEN:
            self.damage.append(Damage(footer.summary_start, "the index there cannot be taken apart"))
            return None, None

    def _pieces(self, file: IO[bytes], summary: Summary | None) -> Iterator[_Piece]:
        """What holds messages, by the index or, without one, from record to record."""
        statistics = summary.statistics if summary is not None else None
        if summary is not None and statistics and 0 < statistics.chunk_count == len(summary.chunk_indexes):
            for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
                yield from self._indexed(file, index)
        else:
            yield from self._walk(file)

    def _indexed(self, file: IO[bytes], index: ChunkIndex) -> Iterator[_Piece]:
        at, length = index.chunk_start_offset, index.chunk_length - _HEAD.size
        if length > LIMIT:
            self.damage.append(Damage(at, f"the chunk there has {length} bytes: no more than {LIMIT} are read"))
            return
        if length < 0 or at + index.chunk_length > file.seek(0, os.SEEK_END):
            self.damage.append(Damage(at, "the index says that a chunk is there, where none can be"))
            return
        record = _read(file, at, index.chunk_length)
        if record[: _HEAD.size] != _HEAD.pack(Opcode.CHUNK, length):
            self.damage.append(Damage(at, "the head of the chunk there is damaged, its messages are shown if whole"))
        yield _Piece(at, Opcode.CHUNK, record[_HEAD.size :], _span(index))

    def _walk(self, file: IO[bytes]) -> Iterator[_Piece]:
        """Step from record to record until the end or to where none can be."""
        size = file.seek(0, os.SEEK_END)
        at = len(MAGIC)
        in_data = True
        while at < size:
            head = _read(file, at, _HEAD.size)
            left = size - at - _HEAD.size
            if left < 0:
                self.damage.append(Damage(at, "the record there is cut"))
                return
            opcode, length = _HEAD.unpack(head)
            if not opcode:
                self.damage.append(Damage(at, f"no record begins there, and the last {size - at} bytes are not read"))
                return
            if length > left:
                self.damage.append(
                    Damage(at, f"the {_named(opcode)} there should have {length} bytes, {left} are there")
                )
                return
            in_data = in_data and opcode != Opcode.DATA_END
            if in_data and opcode in _HOLDS_MESSAGES:
                if length > LIMIT:
                    words = f"the {_named(opcode)} there has {length} bytes: no more than {LIMIT} are read"
                    self.damage.append(Damage(at, words))
                else:
                    yield _Piece(at, opcode, _read(file, at + _HEAD.size, length))
            at += _HEAD.size + length
            if opcode == Opcode.FOOTER:
                after = size - at - len(MAGIC)
                self.cut = after < 0
                if self.cut:
                    break
                if after:
                    self.damage.append(Damage(size - after, f"{after} bytes follow the end"))
                elif _read(file, at, len(MAGIC)) != MAGIC:
                    self.damage.append(Damage(at, "the magic bytes of the end are damaged"))
                return
        self.damage.append(Damage(at, "it stops there"))

    def _check_data(self, file: IO[bytes], footer: Footer) -> None:
        """What lies between the chunks has one checksum, if its writer made one: ours does."""
        at = footer.summary_start - _DATA_END_SIZE
        record = _read(file, at, _DATA_END_SIZE)
        if _HEAD.unpack_from(record) != (Opcode.DATA_END, _DATA_END_SIZE - _HEAD.size):
            self.damage.append(Damage(at, "the end of the messages is damaged, no message is"))
            return
        said = DataEnd.read(ReadDataStream(BytesIO(record[_HEAD.size :]))).data_section_crc
        if said and said != _checksum(file, 0, at):
            words = "the checksum there fails: something before it is damaged, but no message"
            self.damage.append(Damage(at, words))


def _read(file: IO[bytes], at: int, length: int) -> bytes:
    file.seek(at)
    return file.read(length)


def _checksum(file: IO[bytes], start: int, end: int) -> int:
    crc = 0
    file.seek(start)
    while start < end and (block := file.read(min(_BLOCK, end - start))):
        crc = zlib.crc32(block, crc)
        start += len(block)
    return crc


def _named(opcode: int) -> str:
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return "record"


def _span(index: ChunkIndex) -> str:
    try:
        first, last = (
            datetime.fromtimestamp(ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]
            for ns in (index.message_start_time, index.message_end_time)
        )
    except (OverflowError, ValueError, OSError):
        return ""  # somebody else's clock
    return f" (its messages, {first} to {last} UTC, are lost)"
