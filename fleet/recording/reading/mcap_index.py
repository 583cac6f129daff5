"""What stands at the end of a whole MCAP file: where its chunks are, and its channels. No message is read here.

The mcap library reads it too, but takes each chunk's table of channels apart: with 1,000 channels and an hour of chunks
that are millions of entries. Here that table stays bytes until somebody asks whether a channel is in it.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

LIMIT: Final = 80 * 2**20
"""No record, and no chunk when uncompressed, is read if it is larger. The recorder takes up to 64 MiB at once, and
ends a chunk with the message that brings it over 1 MiB."""
HEAD: Final = struct.Struct("<BQ")  # opcode, length

_CHUNK: Final = struct.Struct("<QQQQI")  # first and last log time, offset, length, bytes of the table of channels
_ENTRY: Final = struct.Struct("<HQ")  # of that table: channel, offset of its message index


@dataclass(frozen=True, slots=True)
class Place:
    """One chunk: where it is, and from when to when its messages are."""

    at: int
    length: int
    first_ns: int
    last_ns: int
    table: bytes

    def holds(self, channels: frozenset[int]) -> bool:
        """Whether it may have messages of one of these; a writer that made no table leaves it open."""
        return not self.table or any(channel in channels for channel, _ in _ENTRY.iter_unpack(self.table))


@dataclass(slots=True)
class Index:
    """A file's chunks, in the order of the file, its schemas and channels by id, and its statistics."""

    places: list[Place] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None

    @property
    def complete(self) -> bool:
        """Whether it names every chunk, and no message is outside of them."""
        said = self.statistics
        return said is not None and said.chunk_count == len(self.places) and bool(self.places or not said.message_count)

    @property
    def describes(self) -> bool:
        """Whether it has every channel: if not, chunks that are passed over may have the description of one."""
        return (
            self.statistics is not None
            and self.statistics.channel_count == len(self.channels)
            and all(not channel.schema_id or channel.schema_id in self.schemas for channel in self.channels.values())
        )

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by key."""
        counts: dict[str, int] = {}
        if self.statistics is not None:
            for channel, count in self.statistics.channel_message_counts.items():
                if channel in self.channels:
                    key = self.channels[channel].topic
                    counts[key] = counts.get(key, 0) + count
        return counts


def read(file: IO[bytes], start: int, end: int) -> Index:
    """Take the records between two offsets apart; raises what the mcap library and struct raise for broken ones."""
    index = Index()
    for opcode, body in _records(file, start, end):
        match opcode:
            case Opcode.CHUNK_INDEX:
                first, last, at, length, table = _CHUNK.unpack_from(body)
                if table % _ENTRY.size or _CHUNK.size + table > len(body):
                    raise EndOfFile
                index.places.append(Place(at, length, first, last, body[_CHUNK.size : _CHUNK.size + table]))
            case Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(body)))
                index.schemas[schema.id] = schema
            case Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(body)))
                index.channels[channel.id] = channel
            case Opcode.STATISTICS:
                index.statistics = Statistics.read(ReadDataStream(BytesIO(body)))
            case _:
                pass
    index.places.sort(key=lambda place: place.at)
    return index


def _records(file: IO[bytes], start: int, end: int) -> Iterator[tuple[int, bytes]]:
    file.seek(start)
    at = start
    while at < end:
        opcode, length = HEAD.unpack(file.read(HEAD.size))
        at += HEAD.size + length
        if length > LIMIT or at > end:
            raise EndOfFile
        yield opcode, file.read(length)
