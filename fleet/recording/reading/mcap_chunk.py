"""Decodes one chunk of an MCAP file: decompresses it, checks its CRC and splits it into records.

The mcap library does not decompress and split it here: it would allocate as much as a damaged length says, and take
eight times as long. It parses the head and checks the CRC.
"""

import struct
from dataclasses import replace
from io import BytesIO
from typing import IO, Final

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from msgspec import Struct

from fleet.recording.reading.mcap_index import HEAD, MAX_RECORD_BYTES

_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
MAX_CHUNK_BYTES: Final = 2**30
MAX_RATIO: Final = 64
"""Limits for a chunk that is larger than MAX_RECORD_BYTES when decompressed: its size then, and how many times the
compressed size that is. So a few bytes cannot fill the memory. Readings compress by a factor of 3 to 20."""
# Errors that the mcap library and the decompressors raise for corrupted bytes.
BROKEN: Final = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)

Record = tuple[int, int, int, int, bytes]
"""A message is (channel, sequence, log time, publish time, payload). A channel or schema is (-opcode, 0, 0, 0, body):
the negative first number shows that it is not a message."""


class Damage(Struct, frozen=True):
    """One corrupted or missing part of a file."""

    at: int
    """Byte offset."""
    words: str

    def __str__(self) -> str:
        return f"byte {self.at}: {self.words}"


class ChunkPart(Struct, frozen=True):
    """The bytes of a chunk, or of one record in a file without chunks."""

    at: int
    opcode: int
    body: bytes
    span: str = ""
    """Time span of its messages as text. Empty without an index."""

    def check(self) -> None:
        """Check its CRC. Raises one of BROKEN."""
        get_chunk_data_stream(self._plain(), validate_crc=True)

    def records(self) -> list[Record]:
        """Return its messages, channels and schemas in order. Raises one of BROKEN."""
        chunk = self._plain()
        stream, end = get_chunk_data_stream(chunk, validate_crc=True)
        data = chunk.data if not chunk.compression else stream.read(end)
        found: list[Record] = []
        unpack = _MESSAGE_HEAD.unpack_from
        at = 0
        while at < end:
            if data[at] == Opcode.MESSAGE:
                _, length, channel, sequence, log_ns, publish_ns = unpack(data, at)
                begin, at = at + _MESSAGE_HEAD.size, at + HEAD.size + length
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
                    # Parse the record already here, although only its body is returned. So a chunk with one corrupted
                    # record yields no message at all.
                    (Channel if opcode == Opcode.CHANNEL else Schema).read(ReadDataStream(BytesIO(body)))
                    found.append((-opcode, 0, 0, 0, body))
        return found

    @property
    def is_intact(self) -> bool:
        """True if all its records can be read."""
        try:
            self.records()
        except BROKEN:
            return False
        return True

    def lost(self, error: Exception) -> Damage:
        """Return the damage that an error of `records` means."""
        match error:
            case CRCValidationError():
                words = "fails its checksum"
            case ValueError() if not isinstance(error, UnicodeError):
                words = str(error)
            case _:
                words = "cannot be parsed"
        return Damage(self.at, f"the {named(self.opcode)} there {words}{self.span}")

    def _plain(self) -> Chunk:
        """Return the decompressed chunk, with its CRC unchecked."""
        if self.opcode != Opcode.CHUNK:
            return Chunk(
                "",
                HEAD.pack(self.opcode, len(self.body)) + self.body,
                0,
                0,
                0,
                HEAD.size + len(self.body),
            )
        chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(self.body)))
        size = chunk.uncompressed_size
        most = min(max(MAX_RECORD_BYTES, len(chunk.data) * MAX_RATIO), MAX_CHUNK_BYTES)
        if size > most:
            raise ValueError(
                f"says that it has {size} bytes when decompressed from {len(chunk.data)}, more than the limit of "
                f"{most}: it was not read, and may be intact"
            )
        # Ask for one byte more than the chunk says. This detects a larger chunk without decompressing all of it.
        data: bytes
        match chunk.compression:
            case "":
                return chunk
            case "zstd":
                data = (
                    zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES)
                    .stream_reader(chunk.data, read_across_frames=True)
                    .read(size + 1)
                )
            case "lz4":
                data = _lz4(chunk.data, size + 1)
            case other:
                raise ValueError(f"has a compression that is not known: {other[:20]!r}")
        if len(data) != size:
            raise EndOfFile
        plain: Chunk = replace(chunk, compression="", data=data)
        return plain


def _lz4(data: bytes, most: int) -> bytes:
    """Return the plain bytes of all frames, at most `most` bytes."""
    plain = b""
    while data and len(plain) < most:
        frame = lz4.frame.LZ4FrameDecompressor()
        plain += frame.decompress(data, max_length=most - len(plain))
        data = (frame.unused_data or b"") if frame.eof else b""
    return plain


def read(file: IO[bytes], at: int, length: int) -> bytes:
    """Return the bytes from an offset on. There are fewer at the end of the file."""
    file.seek(at)
    return file.read(length)


def named(opcode: int) -> str:
    """Return the name of a record type."""
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return "record"
