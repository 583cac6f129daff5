"""Reads the intact messages of an MCAP file, and reports where and why others are lost. Repairs nothing.

The mcap library parses every record except messages. Chunks (mcap_chunk.py) and the scan of files without an index
(mcap_scan.py) are our own: the library gives up at the first damage, and needs 1.0 us for a message instead of 0.12.
If the file has an index (mcap_index.py), the reader opens only the selected chunks, and a damaged chunk does not hide
others.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, Metadata, Schema
from mcap.stream_reader import CRCValidationError

from fleet.recording.reading import mcap_index
from fleet.recording.reading.mcap_chunk import BROKEN, ChunkPart, Damage, Record, read
from fleet.recording.reading.mcap_index import HEAD, MAX_RECORD_BYTES, ChunkPlace, Index
from fleet.recording.reading.mcap_scan import MAGIC, RecordScanner
from fleet.recording.selection import EVERYTHING, Selection
from schemas.local_time import exact

_FOOTER_SIZE: Final = HEAD.size + 20
_DATA_END_SIZE: Final = HEAD.size + 4
_CRC: Final = struct.Struct("<I")
_BLOCK: Final = 2**20
_HEADER_LIMIT: Final = 2**16


class NotMcap(Exception):
    """The file is missing, cannot be read, or is not an MCAP file. The message gives the reason."""


class ChannelInfo(NamedTuple):
    """A channel, and its schema if it has one."""

    channel: Channel
    schema: Schema | None


Row = tuple[ChannelInfo, int, int, int, bytes]
"""One message: channel, sequence, log time and publish time in ns, payload. A plain tuple, because there are
millions."""


Extra = Attachment | Metadata
"""The records of a file besides its messages."""


class McapReader:
    """Reader of one MCAP file. Raises NotMcap.

    `damage` lists the damage that `check` or `messages` have found so far.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[Damage] = []
        self.cut = False
        """True if the file is truncated: its writer was killed, or is still writing."""
        self._bad_magic = False
        if not path.is_file():
            raise NotMcap("is not a regular file" if path.exists() else "is missing")
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
                self._bad_magic = len(head) == len(MAGIC) and head != MAGIC and _is_mcap(file)
        except OSError as error:
            raise NotMcap(f"cannot be read: {error.strerror}") from None
        if not head:
            raise NotMcap("is empty: the recorder ended before it wrote anything")
        if head != MAGIC and not self._bad_magic:
            early = MAGIC.startswith(head)
            raise NotMcap(
                f"is cut at byte {len(head)}, before anything was recorded"
                if early
                else "is not an MCAP file: it does not begin with MCAP's magic bytes"
            )

    @property
    def words(self) -> str:
        """Return the damage on one line, or an empty text if there is none."""
        if not self.damage:
            return ""
        kind = "is damaged"
        if self.cut:
            kind = "is cut (the recorder was killed, is still at work, or had no room for the end)" + (
                "" if self.only_cut else " and damaged"
            )
        more = f" and in {len(self.damage) - 3} other places" if len(self.damage) > 3 else ""
        return f"{kind}: {'; '.join(str(damage) for damage in self.damage[:3])}{more}"

    @property
    def only_cut(self) -> bool:
        """True if the only damage is that the file is truncated."""
        return self.cut and len(self.damage) == 1

    def check(self) -> None:
        """Check every CRC without parsing messages.

        If a chunk is damaged, do not check attachments, metadata and the bytes between chunks.
        """
        self._begin()
        try:
            with self.path.open("rb") as file:
                footer, summary = self._index(file)
                for part in self._parts(file, summary):
                    try:
                        part.check()
                    except BROKEN as error:
                        self.damage.append(part.lost(error))
                if not self.damage:
                    self._read_extras(file, summary)
                if footer is not None and not self.damage:
                    self._check_data(file, footer)
        except OSError as error:
            self._unreadable(error)

    def messages(self, selection: Selection = EVERYTHING) -> Iterator[Row]:
        """Yield every intact selected message in the order of the file. At most one chunk is in memory.

        With an intact index, read only chunks that may contain a selected message. Without one, read all chunks.
        """
        self._begin()
        try:
            with self.path.open("rb") as file:
                _, index = self._index(file)
                known = {} if index is None else dict(index.channels)
                schemas: dict[int, Schema | None] = {0: None} if index is None else {0: None, **index.schemas}
                channels = _Channels(known, schemas, selection)
                strays: list[int] = []
                for part in self._parts(file, index, selection):
                    try:
                        records = part.records()
                    except BROKEN as error:
                        self.damage.append(part.lost(error))
                        continue
                    yield from channels.rows(records, part.at, strays)
                counted = channels.count + len(strays)
                if selection == EVERYTHING and not self.damage and index is not None and index.statistics is not None:
                    said = index.statistics.message_count
                    if said != counted:
                        words = f"the statistics there say {said} messages, {counted} are in the file"
                        self.damage.append(Damage(index.statistics_at, words))
                if strays:
                    words = f"{len(strays)} messages after it belong to channels whose description is lost"
                    self.damage.append(Damage(strays[0], words))
        except OSError as error:
            self._unreadable(error)

    def extras(self) -> list[Extra]:
        """Return the intact attachments and metadata records. `damage` then lists only damage of such records."""
        self._begin()
        try:
            with self.path.open("rb") as file:
                _, index = self._index(file)
                self.damage.clear()
                return self._read_extras(file, index)
        except OSError as error:
            self._unreadable(error)
            return []

    def _read_extras(self, file: IO[bytes], index: Index | None) -> list[Extra]:
        found: list[Extra] = []
        for part in self._extra_parts(file, index):
            try:
                found.append(_parse_extra(part))
            except BROKEN as error:
                self.damage.append(part.lost(error))
        return found

    def _extra_parts(self, file: IO[bytes], index: Index | None) -> Iterator[ChunkPart]:
        if index is None or not index.has_all_extras:
            yield from RecordScanner(file).parts(extras=True)
            return
        for at, length in index.extras:
            if not HEAD.size <= length <= MAX_RECORD_BYTES:
                words = f"the record there has {length} bytes, more than the limit of {MAX_RECORD_BYTES}"
                self.damage.append(Damage(at, words))
                continue
            record = read(file, at, length)
            opcode, size = HEAD.unpack_from(record) if len(record) == length else (0, 0)
            if opcode not in (Opcode.ATTACHMENT, Opcode.METADATA) or size != length - HEAD.size:
                self.damage.append(Damage(at, "the index gives an impossible place of an attachment or of metadata"))
                continue
            yield ChunkPart(at, opcode, record[HEAD.size :])

    def index(self) -> Index | None:
        """Return the index if it is intact and lists every chunk, else None. Raises OSError if reading fails."""
        self._begin()
        with self.path.open("rb") as file:
            _, index = self._index(file)
        return index if index is not None and index.has_all_chunks else None

    def _begin(self) -> None:
        self.damage, self.cut = [], False
        if self._bad_magic:
            self.damage.append(Damage(0, "the magic bytes of the beginning are damaged"))

    def _unreadable(self, error: OSError) -> None:
        self.damage.append(Damage(0, f"it cannot be read: {error.strerror}"))

    def _index(self, file: IO[bytes]) -> tuple[Footer | None, Index | None]:
        """Return the footer and index of a file, or None if they are missing or fail the CRC."""
        size = file.seek(0, os.SEEK_END)
        at = size - _FOOTER_SIZE - len(MAGIC)
        tail = read(file, max(at, 0), _FOOTER_SIZE + len(MAGIC))
        if at < len(MAGIC) or not tail.endswith(MAGIC):
            return None, None  # the scan will distinguish a cut file from a file with bytes after its end
        if HEAD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_SIZE - HEAD.size):
            self.damage.append(Damage(at, "there is no footer"))
            return None, None
        footer = Footer.read(ReadDataStream(BytesIO(tail[HEAD.size :])))
        if not footer.summary_start or not footer.summary_crc:
            return None, None  # a file of another writer, without an index or without its CRC
        if not len(MAGIC) + _DATA_END_SIZE <= footer.summary_start <= at:
            self.damage.append(Damage(at, "the footer gives an impossible place of the index"))
            return None, None
        if _checksum(file, footer.summary_start, at + _FOOTER_SIZE - 4) != footer.summary_crc:
            self.damage.append(Damage(footer.summary_start, "the index there fails its checksum"))
            return None, None
        try:
            return footer, mcap_index.read(file, footer.summary_start, at)
        except BROKEN:
            self.damage.append(Damage(footer.summary_start, "the index there cannot be parsed"))
            return None, None

    def _parts(self, file: IO[bytes], index: Index | None, selection: Selection = EVERYTHING) -> Iterator[ChunkPart]:
        """Yield the parts with messages, from the index or, without one, by a scan."""
        if index is None or not index.has_all_chunks:
            scanner = RecordScanner(file)
            for part in scanner.parts():
                self.damage += scanner.damage
                scanner.damage.clear()
                yield part
            self.damage += scanner.damage
            self.cut = scanner.cut
            return
        chunks = index.chunks
        if index.has_all_channels:
            selected = frozenset(number for number, one in index.channels.items() if selection.has_key(one.topic))
            every = len(selected) == len(index.channels)
            chunks = [
                chunk
                for chunk in chunks
                if selection.overlaps(chunk.first_ns, chunk.last_ns) and (every or chunk.may_contain(selected))
            ]
        for chunk in chunks:
            yield from self._indexed(file, chunk)

    def _indexed(self, file: IO[bytes], chunk: ChunkPlace) -> Iterator[ChunkPart]:
        at, length = chunk.at, chunk.length - HEAD.size
        if length > MAX_RECORD_BYTES:
            self.damage.append(
                Damage(at, f"the chunk there has {length} bytes, more than the limit of {MAX_RECORD_BYTES}")
            )
            return
        if length < 0 or at + chunk.length > file.seek(0, os.SEEK_END):
            self.damage.append(Damage(at, "the index gives an impossible place of a chunk"))
            return
        record = read(file, at, chunk.length)
        if record[: HEAD.size] != HEAD.pack(Opcode.CHUNK, length):
            self.damage.append(Damage(at, "the head of the chunk there is damaged; its intact messages are read"))
        yield ChunkPart(at, Opcode.CHUNK, record[HEAD.size :], _span(chunk))

    def _check_data(self, file: IO[bytes], footer: Footer) -> None:
        """Check the CRC of the whole data section, which covers the bytes between chunks. Some writers omit it."""
        at = footer.summary_start - _DATA_END_SIZE
        record = read(file, at, _DATA_END_SIZE)
        if HEAD.unpack_from(record) != (Opcode.DATA_END, _DATA_END_SIZE - HEAD.size):
            self.damage.append(Damage(at, "the end of the data section is damaged; every message is intact"))
            return
        expected = DataEnd.read(ReadDataStream(BytesIO(record[HEAD.size :]))).data_section_crc
        if expected and expected != _checksum(file, 0, at):
            words = "the checksum there fails: something before it is damaged, but no message"
            self.damage.append(Damage(at, words))


class _Channels:
    """Channels of a file found so far, and whether each is selected."""

    def __init__(self, channels: dict[int, Channel], schemas: dict[int, Schema | None], selection: Selection) -> None:
        self._channels = channels
        self._schemas = schemas
        self._selection = selection
        self._found: dict[int, ChannelInfo | None] = {}
        self.count = 0
        """Number of messages of known channels in the chunks so far, selected or not. Valid only between chunks."""

    def rows(self, records: list[Record], at: int, strays: list[int]) -> Iterator[Row]:
        """Yield the selected messages of one chunk. For each message of an unknown channel add `at` to `strays`."""
        found, selection = self._found, self._selection
        timed = selection.start_ns is not None or selection.end_ns is not None
        before = len(strays)
        described = 0
        for number, sequence, log_ns, publish_ns, data in records:
            if number < 0:
                self._describe(-number, data)
                described += 1
                continue
            try:
                info = found[number]
            except KeyError:
                channel = self._channels.get(number)
                if channel is None or channel.schema_id not in self._schemas:
                    strays.append(at)
                    continue
                selected = selection.has_key(channel.topic)
                info = found[number] = ChannelInfo(channel, self._schemas[channel.schema_id]) if selected else None
            if info is not None and (not timed or selection.has_time(log_ns)):
                yield info, sequence, log_ns, publish_ns, data
        self.count += len(records) - described - (len(strays) - before)

    def _describe(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            if self._channels.get(channel.id) != channel:
                self._channels[channel.id] = channel
                self._found.pop(channel.id, None)
        else:
            schema = Schema.read(stream)
            if self._schemas.get(schema.id) != schema:
                self._schemas[schema.id] = schema
                self._found.clear()


def _parse_extra(part: ChunkPart) -> Extra:
    """Parse an attachment or a metadata record. Raises one of BROKEN."""
    stream = ReadDataStream(BytesIO(part.body))
    if part.opcode == Opcode.METADATA:
        metadata: Metadata = Metadata.read(stream)
        return metadata
    attachment: Attachment = Attachment.read(stream)
    (expected,) = _CRC.unpack(part.body[-_CRC.size :])
    actual = zlib.crc32(part.body[: -_CRC.size])
    if expected and expected != actual:
        raise CRCValidationError(expected, actual, attachment)
    return attachment


def _is_mcap(file: IO[bytes]) -> bool:
    """Return True if a file without the magic bytes has the end, the header or an intact chunk of an MCAP file."""
    end = file.seek(0, os.SEEK_END) - len(MAGIC)
    if end > len(MAGIC) and read(file, end, len(MAGIC)) == MAGIC:
        return True
    head = read(file, len(MAGIC), HEAD.size)
    if len(head) == HEAD.size and (length := HEAD.unpack(head)[1]) < _HEADER_LIMIT and head[0] == Opcode.HEADER:
        body = BytesIO(file.read(length))
        try:
            Header.read(ReadDataStream(body))
        except BROKEN:
            pass
        else:
            return bool(body.tell() == length)
    return RecordScanner(file).chunk_from(len(MAGIC)) is not None


def _checksum(file: IO[bytes], start: int, end: int) -> int:
    crc = 0
    file.seek(start)
    while start < end and (block := file.read(min(_BLOCK, end - start))):
        crc = zlib.crc32(block, crc)
        start += len(block)
    return crc


def _span(chunk: ChunkPlace) -> str:
    return f" (its messages, {exact(chunk.first_ns)} to {exact(chunk.last_ns)}, are lost)"
