"""Reads the index at the end of an MCAP file: its chunks, channels and schemas. Reads no message.

The mcap library is not used for this, because it parses the channel table of each chunk. With 1,000 channels, an hour
of chunks has millions of entries. Here, a table stays unparsed until `may_contain` searches it.
"""

import struct
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import IO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
from msgspec import Struct, field

MAX_RECORD_BYTES: Final = 80 * 2**20
"""Maximum size of a record to read. A chunk may be larger when it is decompressed (`mcap_chunk.MAX_RATIO`).

The recorder accepts messages of up to 64 MiB, and ends a chunk with the message that brings it over 1 MiB.
"""
HEAD: Final = struct.Struct("<BQ")  # opcode, length

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")  # first and last log time, offset, length, bytes of the table of channels
_EXTRA_INDEX: Final = struct.Struct("<QQ")  # offset, length of an attachment or a metadata record
_CHANNEL_ENTRY: Final = struct.Struct("<HQ")  # of that table: channel, offset of its message index


class ChunkPlace(Struct, frozen=True):
    """Position and time span of one chunk."""

    at: int
    length: int
    first_ns: int
    last_ns: int
    table: bytes

    @property
    def channel_count(self) -> int:
        """Return the number of channels with messages in it. 0 if it has no table."""
        return len(self.table) // _CHANNEL_ENTRY.size

    def may_contain(self, channels: frozenset[int]) -> bool:
        """Return True if it may contain messages of these channels. A chunk without a table may contain any."""
        return not self.table or any(channel in channels for channel, _ in _CHANNEL_ENTRY.iter_unpack(self.table))


class Index(Struct):
    """Chunks in the order of the file, schemas and channels by id, and statistics."""

    chunks: list[ChunkPlace] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    statistics_at: int = 0
    """Offset of the statistics."""
    extras: list[tuple[int, int]] = field(default_factory=list)
    """Offset and length of each attachment and metadata record."""

    @property
    def has_all_chunks(self) -> bool:
        """True if it lists every chunk, and no message is outside of chunks."""
        statistics = self.statistics
        return (
            statistics is not None
            and statistics.chunk_count == len(self.chunks)
            and bool(self.chunks or not statistics.message_count)
        )

    @property
    def has_all_channels(self) -> bool:
        """True if it describes every channel. If not, a skipped chunk might describe one."""
        return (
            self.statistics is not None
            and self.statistics.channel_count == len(self.channels)
            and all(not channel.schema_id or channel.schema_id in self.schemas for channel in self.channels.values())
        )

    @property
    def counts_all_messages(self) -> bool:
        """True if the counts by channel are complete, so that no message must be read to count them."""
        statistics = self.statistics
        if statistics is None or not (self.has_all_chunks and self.has_all_channels):
            return False
        counts = statistics.channel_message_counts
        return counts.keys() <= self.channels.keys() and sum(counts.values()) == statistics.message_count

    @property
    def has_all_extras(self) -> bool:
        """True if it lists every attachment and metadata record."""
        statistics = self.statistics
        return statistics is not None and statistics.attachment_count + statistics.metadata_count == len(self.extras)

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the number of messages by key."""
        counts: dict[str, int] = {}
        if self.statistics is not None:
            for channel, count in self.statistics.channel_message_counts.items():
                if channel in self.channels:
                    key = self.channels[channel].topic
                    counts[key] = counts.get(key, 0) + count
        return counts


def read(file: IO[bytes], start: int, end: int) -> Index:
    """Parse the index between two offsets. Raises one of `mcap_chunk.BROKEN` if it is corrupted."""
    index = Index()
    for at, opcode, body in _records(file, start, end):
        match opcode:
            case Opcode.CHUNK_INDEX:
                first, last, chunk_at, length, table = _CHUNK_INDEX.unpack_from(body)
                if table % _CHANNEL_ENTRY.size or _CHUNK_INDEX.size + table > len(body):
                    raise EndOfFile
                index.chunks.append(
                    ChunkPlace(chunk_at, length, first, last, body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + table])
                )
            case Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(body)))
                index.schemas[schema.id] = schema
            case Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(body)))
                index.channels[channel.id] = channel
            case Opcode.ATTACHMENT_INDEX | Opcode.METADATA_INDEX:
                index.extras.append(_EXTRA_INDEX.unpack_from(body))
            case Opcode.STATISTICS:
                index.statistics_at = at
                index.statistics = Statistics.read(ReadDataStream(BytesIO(body)))
            case _:
                pass
    index.chunks.sort(key=lambda chunk: chunk.at)
    return index


def _records(file: IO[bytes], start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    file.seek(start)
    at = start
    while at < end:
        opcode, length = HEAD.unpack(file.read(HEAD.size))
        at += HEAD.size + length
        if length > MAX_RECORD_BYTES or at > end:
            raise EndOfFile
        yield at - HEAD.size - length, opcode, file.read(length)
