"""One chunk of an MCAP file as bytes: taken out, held against its checksum, taken apart. Where chunks are is walk.py's.

The mcap library would allocate what a damaged length says, and takes eight times as long for each message.
"""

import struct
from dataclasses import dataclass, replace
from io import BytesIO
from typing import IO, Final

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream

from fleet.recording.reading.mcap_index import HEAD, LIMIT

_MESSAGE: Final = struct.Struct("<BQHIQQ")  # the head, channel, sequence, log time, publish time
# The ways in which the library, and what it decompresses with, say that bytes are not what they should be.
BROKEN: Final = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)

Record = tuple[int, int, int, int, bytes]
"""Channel, sequence, log time, publish time, payload; what describes channels: minus its opcode, 0, 0, 0, body."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is wrong with a file."""

    at: int
    """Offset in bytes of what could not be read."""
    words: str

    def __str__(self) -> str:
        return f"byte {self.at}: {self.words}"


@dataclass(frozen=True, slots=True)
class ChunkPart:
    """A chunk, or in a file without chunks one record, as bytes."""

    at: int
    opcode: int
    body: bytes
    span: str = ""
    """From when to when it has messages; empty where the index does not say so."""

    def check(self) -> None:
        """Hold it against its checksum; raises one of BROKEN."""
        get_chunk_data_stream(self._plain(), validate_crc=True)

    def records(self) -> list[Record]:
        """Its messages, and what describes channels, in order; raises one of BROKEN."""
        chunk = self._plain()
        stream, end = get_chunk_data_stream(chunk, validate_crc=True)
        data = chunk.data if not chunk.compression else stream.read(end)
        found: list[Record] = []
        unpack = _MESSAGE.unpack_from
        at = 0
        while at < end:
            if data[at] == Opcode.MESSAGE:
                _, length, channel, sequence, log_ns, publish_ns = unpack(data, at)
                begin, at = at + _MESSAGE.size, at + HEAD.size + length
                if at < begin or at > end:
                    raise EndOfFile
                found.append((channel, sequence, log_ns, publish_ns, data[begin:at]))
            else:
                opcode, length = HEAD.unpack_from(data, at)
                begin, at = at + HEAD.size, at + HEAD.size + length
                if at > end:
                    raise EndOfFile
                if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                    body = data[begin:at]
                    # Taken apart here too: a chunk of which one record is broken gives none.
                    (Channel if opcode == Opcode.CHANNEL else Schema).read(ReadDataStream(BytesIO(body)))
                    found.append((-opcode, 0, 0, 0, body))
        return found

    @property
    def whole(self) -> bool:
        """Whether every record of it can be had."""
        try:
            self.records()
        except BROKEN:
            return False
        return True

    def lost(self, error: Exception) -> Damage:
        """Why this was not read."""
        match error:
            case CRCValidationError():
                words = "fails its checksum"
            case ValueError() if not isinstance(error, UnicodeError):
                words = str(error)
            case _:
                words = "cannot be taken apart"
        return Damage(self.at, f"the {named(self.opcode)} there {words}{self.span}")

    def _plain(self) -> Chunk:
        """Its records, uncompressed, not yet checked."""
        if self.opcode != Opcode.CHUNK:
            return Chunk("", HEAD.pack(self.opcode, len(self.body)) + self.body, 0, 0, 0, HEAD.size + len(self.body))
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


def read(file: IO[bytes], at: int, length: int) -> bytes:
    """Bytes from an offset on; fewer at the end."""
    file.seek(at)
    return file.read(length)


def named(opcode: int) -> str:
    """What a record is called."""
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return "record"
