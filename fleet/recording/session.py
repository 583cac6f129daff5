"""Reading a session back: its segments, its description, every message that is whole. Nothing is repaired here.

A session is a directory (directory.py) or a bare .mcap, also somebody else's. One that was cut gives every whole chunk.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message, Schema
from mcap.writer import Writer

from fleet.recording import directory

MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD: Final = struct.Struct("<BQ")  # opcode, length
_CHUNK: Final = struct.Struct("<QQQII")  # times, size and CRC of the records, length of a name
_FOOTER: Final = struct.Struct("<BQQQI")  # opcode, length, start of the summary and of its offsets, CRC up to here
_FOOTER_AND_MAGIC: Final = 9 + 20 + len(MAGIC)  # a footer record has a fixed size


class NoSession(Exception):
    """What was named is not a session; its text names it and says why."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a session: payload bytes as they came over the bus."""

    key: str
    payload: bytes
    message: str
    """Full protobuf name; empty where the file has no schema for it."""
    encoding: str
    """MCAP message encoding: `protobuf`, `json`, or what the publisher said."""
    published_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch."""
    recorded_ns: int
    """The recorder's clock, ns since the epoch."""
    sequence: int
    """The publisher's number for the key, modulo 2^32; 0 if it gave none."""


@dataclass(slots=True)
class Session:
    """Segments in order. `cut` is filled from the files' ends; reading finds damage in the middle too, and adds it."""

    path: Path
    segments: tuple[Path, ...]
    description: directory.Description | None
    cut: dict[Path, str] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Find a session's segments; raises NoSession."""
        if path.is_dir():
            segments = tuple(sorted(path.glob(directory.SEGMENTS)))
            if not segments:
                raise NoSession(f"{path} is not a session: no {directory.segment(Path(), 1)} in it")
        elif path.is_file():
            segments = (path,)
        else:
            raise NoSession(
                f"there is no session at {path}: name the directory that `fleet record` printed, or an .mcap"
            )
        found = cls(path, segments, directory.Description.read(path) if path.is_dir() else None)
        if found.description is not None and found.description.format > directory.FORMAT:
            raise NoSession(
                f"{path} has format {found.description.format}, this version reads up to {directory.FORMAT}: update it"
            )
        for segment in segments:
            words = _looks_cut(segment)
            if words:
                found.cut[segment] = words
        return found

    @property
    def name(self) -> str:
        """What to call it: the directory's name, or the file's without its ending."""
        return self.path.resolve().name if self.path.is_dir() else self.path.stem

    @property
    def cut_words(self) -> str:
        """One line on what is missing; empty if the session is whole."""
        return "; ".join(f"{path} {words}" for path, words in self.cut.items())

    def check(self) -> None:
        """Look at every CRC, which reading by way of the index does not; adds what is damaged to `cut`."""
        for segment in self.segments:
            if segment not in self.cut and (words := _damage(segment)):
                self.cut[segment] = words

    def rescue(self, out: Path) -> "Session":
        """Write every whole message into a new, whole file; it as a session. For what was cut or is damaged."""
        channels: dict[tuple[Path, int], int] = {}
        schemas: dict[str, int] = {}
        with out.open("xb") as file:
            writer = Writer(file)
            writer.start(library="zenoh-car-fleet rescue")
            for segment in self.segments:
                for schema, channel, message in self._whole(segment):
                    source = (segment, channel.id)
                    if source not in channels:
                        name = schema.name if schema is not None else ""
                        if schema is not None and name not in schemas:
                            schemas[name] = writer.register_schema(name, schema.encoding, schema.data)
                        channels[source] = writer.register_channel(
                            channel.topic, channel.message_encoding, schemas.get(name, 0), channel.metadata
                        )
                    writer.add_message(
                        channels[source], message.log_time, message.data, message.publish_time, message.sequence
                    )
            writer.finish()  # type: ignore[no-untyped-call]  # mcap's has no return type
        return Session(self.path, (out,), self.description)

    def messages(self) -> Iterator[Recorded]:
        """Every whole message, in the order of writing; see `cut` afterwards. Raises NoSession for a foreign file."""
        for segment in self.segments:
            yield from self._read(segment)

    def _read(self, segment: Path) -> Iterator[Recorded]:
        for schema, channel, message in self._whole(segment):
            yield Recorded(
                key=channel.topic,
                payload=message.data,
                message=schema.name if schema is not None and schema.encoding == "protobuf" else "",
                encoding=channel.message_encoding,
                published_ns=message.publish_time,
                recorded_ns=message.log_time,
                sequence=message.sequence,
            )

    def _whole(self, segment: Path) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """What the stock reader gives, up to where the file ends or is damaged."""
        with segment.open("rb") as file:
            # Its default order is sorted by time, for which it needs the whole file: a cut one would give nothing.
            limit = segment.stat().st_size  # a damaged length asks for more than there is
            reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=limit)
            try:
                yield from reader.iter_messages(log_time_order=False)
            except EndOfFile:
                self.cut.setdefault(segment, "is cut")
            # The ways in which the reader says what is wrong: a CRC is a ValueError, an absurd length a MemoryError.
            except (McapError, ValueError, struct.error, zstandard.ZstdError, MemoryError, OverflowError) as error:
                self.cut.setdefault(segment, f"is damaged, and not read beyond that: {error}")


def _damage(segment: Path) -> str:
    """Why a file with an end is not whole; empty if chunks and summary have the CRCs that they were written with."""
    with segment.open("rb") as file:
        end = file.seek(-_FOOTER_AND_MAGIC, 2)
        _, _, start, _, crc = _FOOTER.unpack(file.read(_FOOTER.size))
        if crc and start:
            file.seek(min(start, end))
            if zlib.crc32(file.read(end + _FOOTER.size - 4 - file.tell())) != crc:
                return "has a damaged end"
        file.seek(len(MAGIC))
        number = 0
        while head := file.read(_RECORD.size):
            if len(head) < _RECORD.size:
                break  # the magic bytes at the end
            opcode, length = _RECORD.unpack(head)
            if opcode != Opcode.CHUNK:
                file.seek(length, 1)
                continue
            number += 1
            body = file.read(length)
            try:
                _, _, size, crc, name_length = _CHUNK.unpack_from(body)
                compression = body[_CHUNK.size : _CHUNK.size + name_length]
                data = body[_CHUNK.size + name_length + 8 :]
                if compression == b"zstd":
                    data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
            except (struct.error, zstandard.ZstdError):
                return f"is damaged in chunk {number}, and not shown beyond that"
            if crc and compression in (b"zstd", b"") and zlib.crc32(data) != crc:
                return f"is damaged in chunk {number}, and not shown beyond that"
    return ""


def _looks_cut(segment: Path) -> str:
    """Why a file has no end; empty if it has one. Raises NoSession if it is no MCAP file at all."""
    try:
        with segment.open("rb") as file:
            head = file.read(len(MAGIC))
            size = file.seek(0, 2)
            file.seek(max(0, size - _FOOTER_AND_MAGIC))
            tail = file.read()
    except OSError as error:
        raise NoSession(f"{segment} cannot be read: {error.strerror}") from None
    if not head:
        raise NoSession(f"{segment} is empty: the recorder ended before it wrote anything")
    if head != MAGIC:
        raise NoSession(f"{segment} is not an MCAP file: it does not begin with MCAP's magic bytes")
    if not tail.endswith(MAGIC) or size <= len(MAGIC):
        return "is cut (it has no end): the recorder was killed or is still at work"
    return ""
