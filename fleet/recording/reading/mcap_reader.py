"""What is whole of one MCAP file, and where and why the rest is not. No sessions here, and nothing is repaired.

The mcap library reads every record but the messages. The way from record to record (walk.py) and within a chunk
(chunk.py) is our own, because the library's is made for whole files: it allocates what a damaged length says, reads to
the end for a negative one, gives up at the first damage without saying where, and takes eight times as long (1.0
instead of 0.12 us a message) as it reads each message's index. A file with an end is not walked at all: its index
(index.py) says where chunks are, so that a damaged one hides no other, and only those that are asked for are read.
"""

import os
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Schema

from fleet.recording.reading import mcap_index
from fleet.recording.reading.mcap_chunk import BROKEN, ChunkPart, Damage, Record, read
from fleet.recording.reading.mcap_index import HEAD, LIMIT, Index, Place
from fleet.recording.reading.mcap_scan import MAGIC, RecordScanner
from fleet.recording.selection import EVERYTHING, Selection

_FOOTER_SIZE: Final = HEAD.size + 20
_DATA_END_SIZE: Final = HEAD.size + 4
_BLOCK: Final = 2**20
_HEADER_LIMIT: Final = 2**16


class NotMcap(Exception):
    """A file of another kind, or none; its text says why."""


class ChannelInfo(NamedTuple):
    """A channel and its schema, if it has one."""

    channel: Channel
    schema: Schema | None


Row = tuple[ChannelInfo, int, int, int, bytes]
"""One message: lane, sequence, log time and publish time in ns, payload. A plain tuple: there are millions."""


class McapReader:
    """One file; raises NotMcap. What is wrong is in `damage`, as far as `check` or `messages` have looked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[Damage] = []
        self.cut = False
        """Whether it has no end: whoever wrote it was killed, or is still writing."""
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
        """What is wrong, on one line; empty if nothing is."""
        if not self.damage:
            return ""
        kind = "is damaged"
        if self.cut:
            kind = "is cut (the recorder was killed or is still at work)" + ("" if self.only_cut else " and damaged")
        more = f" and in {len(self.damage) - 3} other places" if len(self.damage) > 3 else ""
        return f"{kind}: {'; '.join(str(damage) for damage in self.damage[:3])}{more}"

    @property
    def only_cut(self) -> bool:
        """Whether all that is wrong is that it stops somewhere."""
        return self.cut and len(self.damage) == 1

    def check(self) -> None:
        """Hold every checksum against what it is for; no message is taken apart."""
        self._begin()
        try:
            with self.path.open("rb") as file:
                footer, summary = self._index(file)
                for piece in self._pieces(file, summary):
                    try:
                        piece.check()
                    except BROKEN as error:
                        self.damage.append(piece.lost(error))
                if footer is not None and not self.damage:
                    self._check_data(file, footer)
        except OSError as error:
            self._unreadable(error)

    def messages(self, selection: Selection = EVERYTHING) -> Iterator[Row]:
        """Every whole message that is selected, in the order of writing. Never holds more than one chunk.

        With a whole index only the chunks are read that can have one; without, all are.
        """
        self._begin()
        try:
            with self.path.open("rb") as file:
                _, index = self._index(file)
                channels = {} if index is None else dict(index.channels)
                schemas: dict[int, Schema | None] = {0: None} if index is None else {0: None, **index.schemas}
                lanes = _Channels(channels, schemas, selection)
                strays: list[int] = []
                for piece in self._pieces(file, index, selection):
                    try:
                        records = piece.records()
                    except BROKEN as error:
                        self.damage.append(piece.lost(error))
                        continue
                    yield from lanes.rows(records, piece.at, strays)
                if strays:
                    words = f"{len(strays)} messages from there on are of channels that were described in what is lost"
                    self.damage.append(Damage(strays[0], words))
        except OSError as error:
            self._unreadable(error)

    def index(self) -> Index | None:
        """What stands at its end, if it is whole and names every chunk; raises OSError."""
        self._begin()
        with self.path.open("rb") as file:
            _, index = self._index(file)
        return index if index is not None and index.complete else None

    def _begin(self) -> None:
        self.damage, self.cut = [], False
        if self._bad_magic:
            self.damage.append(Damage(0, "the magic bytes of the beginning are damaged"))

    def _unreadable(self, error: OSError) -> None:
        self.damage.append(Damage(0, f"it cannot be read: {error.strerror}"))

    def _index(self, file: IO[bytes]) -> tuple[Footer | None, Index | None]:
        """What stands at the end of a file, if its checksum says that it is whole."""
        size = file.seek(0, os.SEEK_END)
        at = size - _FOOTER_SIZE - len(MAGIC)
        tail = read(file, max(at, 0), _FOOTER_SIZE + len(MAGIC))
        if at < len(MAGIC) or not tail.endswith(MAGIC):
            self.cut = True
            return None, None
        if HEAD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_SIZE - HEAD.size):
            self.damage.append(Damage(at, "there is no footer"))
            return None, None
        footer = Footer.read(ReadDataStream(BytesIO(tail[HEAD.size :])))
        if not footer.summary_start or not footer.summary_crc:
            return None, None  # somebody else's file: without an index, or with one that cannot be checked
        if not len(MAGIC) + _DATA_END_SIZE <= footer.summary_start <= at:
            self.damage.append(Damage(at, "the footer says that the index is where it cannot be"))
            return None, None
        if _checksum(file, footer.summary_start, at + _FOOTER_SIZE - 4) != footer.summary_crc:
            self.damage.append(Damage(footer.summary_start, "the index there fails its checksum"))
            return None, None
        try:
            return footer, mcap_index.read(file, footer.summary_start, at)
        except BROKEN:
            self.damage.append(Damage(footer.summary_start, "the index there cannot be taken apart"))
            return None, None

    def _pieces(self, file: IO[bytes], index: Index | None, selection: Selection = EVERYTHING) -> Iterator[ChunkPart]:
        """What holds messages, by the index or, without one, from record to record."""
        if index is None or not index.complete:
            walk = RecordScanner(file)
            for piece in walk.pieces():
                self.damage += walk.damage
                walk.damage.clear()
                yield piece
            self.damage += walk.damage
            self.cut = self.cut or walk.cut
            return
        places = index.places
        if index.describes:
            wanted = frozenset(number for number, one in index.channels.items() if selection.has_key(one.topic))
            every = len(wanted) == len(index.channels)
            places = [
                place
                for place in places
                if selection.overlaps(place.first_ns, place.last_ns) and (every or place.holds(wanted))
            ]
        for place in places:
            yield from self._indexed(file, place)

    def _indexed(self, file: IO[bytes], place: Place) -> Iterator[ChunkPart]:
        at, length = place.at, place.length - HEAD.size
        if length > LIMIT:
            self.damage.append(Damage(at, f"the chunk there has {length} bytes: no more than {LIMIT} are read"))
            return
        if length < 0 or at + place.length > file.seek(0, os.SEEK_END):
            self.damage.append(Damage(at, "the index says that a chunk is there, where none can be"))
            return
        record = read(file, at, place.length)
        if record[: HEAD.size] != HEAD.pack(Opcode.CHUNK, length):
            self.damage.append(Damage(at, "the head of the chunk there is damaged, its messages are shown if whole"))
        yield ChunkPart(at, Opcode.CHUNK, record[HEAD.size :], _span(place))

    def _check_data(self, file: IO[bytes], footer: Footer) -> None:
        """What lies between the chunks has one checksum, if its writer made one: ours does."""
        at = footer.summary_start - _DATA_END_SIZE
        record = read(file, at, _DATA_END_SIZE)
        if HEAD.unpack_from(record) != (Opcode.DATA_END, _DATA_END_SIZE - HEAD.size):
            self.damage.append(Damage(at, "the end of the messages is damaged, no message is"))
            return
        said = DataEnd.read(ReadDataStream(BytesIO(record[HEAD.size :]))).data_section_crc
        if said and said != _checksum(file, 0, at):
            words = "the checksum there fails: something before it is damaged, but no message"
            self.damage.append(Damage(at, words))


class _Channels:
    """The channels of a file as they become known, and whether each is selected."""

    def __init__(self, channels: dict[int, Channel], schemas: dict[int, Schema | None], selection: Selection) -> None:
        self._channels = channels
        self._schemas = schemas
        self._selection = selection
        self._found: dict[int, ChannelInfo | None] = {}

    def rows(self, records: list[Record], at: int, strays: list[int]) -> Iterator[Row]:
        """The selected messages of one chunk; each of an unknown channel adds `at` to `strays`."""
        found, selection = self._found, self._selection
        timed = selection.start_ns is not None or selection.end_ns is not None
        for number, sequence, log_ns, publish_ns, data in records:
            if number < 0:
                self._describe(-number, data)
                continue
            try:
                lane = found[number]
            except KeyError:
                channel = self._channels.get(number)
                if channel is None or channel.schema_id not in self._schemas:
                    strays.append(at)
                    continue
                wanted = selection.has_key(channel.topic)
                lane = found[number] = ChannelInfo(channel, self._schemas[channel.schema_id]) if wanted else None
            if lane is not None and (not timed or selection.has_time(log_ns)):
                yield lane, sequence, log_ns, publish_ns, data

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


def _is_mcap(file: IO[bytes]) -> bool:
    """Whether a file that does not begin as one has the end, the header or a whole chunk of one."""
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


def _span(place: Place) -> str:
    try:
        first, last = (
            datetime.fromtimestamp(ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3] for ns in (place.first_ns, place.last_ns)
        )
    except (OverflowError, ValueError, OSError):
        return ""  # somebody else's clock
    return f" (its messages, {first} to {last} UTC, are lost)"
