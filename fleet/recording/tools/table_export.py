"""Exports a session to tables, one per message type: files, or Arrow in memory. tables.py defines their columns."""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from google.protobuf.message import DecodeError, Message
from msgspec import Struct, field

from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.mcap_reader import ChannelInfo, Row
from fleet.recording.reading.message_decoder import MessageDecoder, message_of, why_not_decoded
from fleet.recording.tools import tables
from fleet.recording.tools.table_formats import ArrowSink, FileSink, Sink
from schemas import keys, topics
from schemas.commands import COMMANDS

BATCH_BYTES: Final = 4 << 20
"""Buffered size at which a table is written: its payloads, and ROW_BYTES per row. Messages that another table could
not decode do not count."""
ROW_BYTES: Final = 256
OTHER_TABLE: Final = "other"
STRAY_PREFIX: Final = "stray."
"""Prefix of tables with stray messages: the type of each does not fit its key."""


class Exported(Struct, frozen=True):
    """Result of an export."""

    rows: Mapping[str, int]
    """Rows by name of the table."""
    undecoded: int
    """Messages that do not match their protobuf schema. Their bytes are in the table of other messages."""
    left_out: LeftOut = field(default_factory=LeftOut)
    """Messages that are in another table than the one of their key."""
    undated: Mapping[str, int] = field(default_factory=dict)
    """Times that the format cannot hold, by name of the table. They are null there."""


class _Batch(Struct):
    """Buffered messages of a table, by column.

    One object per row would take a third more time for garbage collection.
    """

    infos: list[ChannelInfo] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)

    def part(self, numbers: Sequence[int]) -> "_Batch":
        """Return the messages with these row numbers."""
        columns = (self.infos, self.log_ns, self.publish_ns, self.sequences, self.payloads)
        return _Batch(*([column[number] for number in numbers] for column in columns))  # type: ignore[arg-type]  # lists in the order of the fields

    def extend(self, more: "_Batch") -> None:
        """Add all messages of another batch."""
        self.infos += more.infos
        self.log_ns += more.log_ns
        self.publish_ns += more.publish_ns
        self.sequences += more.sequences
        self.payloads += more.payloads

    def common(self) -> list[tables.Values]:
        """Return the values of the columns that every table has."""
        key_column = [info.channel.topic for info in self.infos]
        cars = {key: tables.car_of(key) for key in set(key_column)}
        return [key_column, [cars[key] for key in key_column], self.log_ns, self.publish_ns, self.sequences]

    def undecoded(self) -> list[tables.Values]:
        """Return the values of the columns of the table of other messages, which are not decoded."""
        texts = [_text(payload) for payload in self.payloads]
        return [
            [message_of(info) or None for info in self.infos],
            [info.channel.message_encoding for info in self.infos],
            texts,
            [None if text is not None else data for data, text in zip(self.payloads, texts, strict=True)],
        ]


class _Table(Struct):
    """One table, and its buffered messages."""

    sink: Sink
    layout: tables.Layout | None
    message_class: type[Message] | None
    name: str
    stray: bool = False
    batch: _Batch = field(default_factory=_Batch)
    size: int = 0
    rows: int = 0

    def write(self) -> _Batch:
        """Write the buffered rows. Return those that do not match their schema."""
        batch, self.batch, self.size = self.batch, _Batch(), 0
        bad = _Batch()
        messages: list[Message] = []
        if self.message_class is not None:
            try:
                messages = list(map(self.message_class.FromString, batch.payloads))
            except DecodeError:
                batch, bad, messages = _split_undecodable(batch, self.message_class)
        if batch.infos:
            own = self.layout.fill(messages) if self.layout is not None else batch.undecoded()
            self.sink.add([*batch.common(), *own])
            self.rows += len(batch.infos)
        return bad


def _split_undecodable(batch: _Batch, message_class: type[Message]) -> tuple[_Batch, _Batch, list[Message]]:
    good: list[int] = []
    bad: list[int] = []
    messages: list[Message] = []
    for number, payload in enumerate(batch.payloads):
        try:
            messages.append(message_class.FromString(payload))
        except DecodeError:
            bad.append(number)
        else:
            good.append(number)
    return batch.part(good), batch.part(bad), messages


class _Export:
    """The tables that the messages of a session have needed so far."""

    def __init__(self, open_sink: Callable[[str, Sequence[tables.Column]], Sink]) -> None:
        self._open_sink = open_sink
        self._decoder = MessageDecoder()
        self._by_channel: dict[int, tuple[ChannelInfo, _Table]] = {}
        self.tables: dict[tuple[type[Message] | None, bool], _Table] = {}
        self.undecoded = 0
        self.left_out = LeftOut()

    def run(self, rows: Iterable[Row]) -> None:
        """Write every message."""
        by_channel = self._by_channel
        for info, sequence, log_ns, publish_ns, payload in rows:
            # Look the channel up by identity, which is fast. Storing the object, too, keeps its id from being reused.
            known = by_channel.get(id(info))
            if known is None:
                message_class = self._decoder.class_of(info)
                stray = message_class is not None and is_stray(info)
                known = by_channel[id(info)] = (info, self._table_for(message_class, stray=stray))
            table = known[1]
            batch = table.batch
            batch.infos.append(info)
            batch.log_ns.append(log_ns)
            batch.publish_ns.append(publish_ns)
            batch.sequences.append(sequence)
            batch.payloads.append(payload)
            table.size += len(payload) + ROW_BYTES
            if table.size >= BATCH_BYTES:
                self._write(table)
        for table in list(self.tables.values()):
            self._write(table)
        if (None, False) in self.tables:  # messages that the other tables could not decode
            self.tables[None, False].write()

    def _write(self, table: _Table) -> None:
        infos = table.batch.infos
        bad = table.write()
        self.undecoded += len(bad.infos)
        if bad.infos:
            self._table_for(None, stray=False).batch.extend(bad)
        unreadable = Counter(info.channel.topic for info in bad.infos)
        for key, count in unreadable.items():
            self.left_out.add(key, LeftOutCause.UNREADABLE, count)
        if table.message_class is None:
            for info in infos:
                if own_type(info.channel.topic) and self._decoder.class_of(info) is None:
                    self.left_out.add(info.channel.topic, why_not_decoded(self._decoder, info))
        if table.stray:
            for key, count in Counter(info.channel.topic for info in infos).items():
                self.left_out.add(key, LeftOutCause.OTHER_TYPE, count - unreadable[key])

    def _table_for(self, message_class: type[Message] | None, *, stray: bool) -> _Table:
        if (message_class, stray) not in self.tables:
            self.tables[message_class, stray] = self._open_table(message_class, stray=stray)
        return self.tables[message_class, stray]

    def _open_table(self, message_class: type[Message] | None, *, stray: bool) -> _Table:
        """Open a new table. Number its name if a table has it already: fields of the type changed in the session."""
        stem = message_class.DESCRIPTOR.full_name if message_class is not None else OTHER_TABLE
        stem = f"{STRAY_PREFIX}{stem}" if stray else stem
        taken = {table.name.lower() for table in self.tables.values()}
        name = next(one for one in numbered(re.sub(r"[^A-Za-z0-9._-]", "_", stem), "-") if one.lower() not in taken)
        layout = tables.Layout(message_class.DESCRIPTOR) if message_class is not None else None
        sink = self._open_sink(name, layout.columns if layout is not None else tables.OTHER_COLUMNS)
        return _Table(sink, layout, message_class, name, stray)

    def close(self) -> None:
        """End every table."""
        for table in self.tables.values():
            table.sink.close()

    def discard(self) -> None:
        """Remove every table, whole or not."""
        for table in self.tables.values():
            table.sink.discard()


def is_stray(info: ChannelInfo) -> bool:
    """Return True if a channel's protobuf type is not the one that we use for its key."""
    own = own_type(info.channel.topic)
    return bool(own) and message_of(info) not in ("", own)


def own_type(key: str) -> str:
    """Return the full name of the message type of a key, or an empty text if the key is not ours."""
    topic = topics.of_key(key)
    if topic is not None:
        return topic.message
    parsed = keys.parse(key)
    command = COMMANDS.get(parsed.topic.rpartition("/")[2]) if parsed is not None else None
    return command.message if command is not None and parsed is not None and parsed.topic.startswith("@cmd/") else ""


def export(rows: Iterable[Row], out: Path, sink: type[FileSink]) -> Exported:
    """Write the tables of messages into an existing directory. Raises OSError if that fails, or FormatMissing.

    After an error, no files are left behind.
    """
    return _export(rows, lambda name, columns: sink(out / f"{name}{sink.ending}", columns))


def arrow_tables(rows: Iterable[Row]) -> tuple[dict[str, Any], Exported]:
    """Return the pyarrow tables of messages by name. Raises FormatMissing if pyarrow is not installed."""
    sinks: dict[str, ArrowSink] = {}
    exported = _export(rows, lambda name, columns: sinks.setdefault(name, ArrowSink(columns)))
    return {name: sink.table() for name, sink in sinks.items()}, exported


def _export(rows: Iterable[Row], open_sink: Callable[[str, Sequence[tables.Column]], Sink]) -> Exported:
    writing = _Export(open_sink)
    try:
        writing.run(rows)
        writing.close()
    except BaseException:
        writing.discard()
        raise
    written = writing.tables.values()
    undated = {table.name: table.sink.undated for table in written if table.sink.undated}
    return Exported({table.name: table.rows for table in written}, writing.undecoded, writing.left_out, undated)


def numbered(name: str, joint: str) -> Iterator[str]:
    """Yield a name, then the same name with 2, 3 and so on. The caller takes the first one that is free."""
    yield name
    yield from (f"{name}{joint}{number}" for number in itertools.count(2))


def _text(payload: bytes) -> str | None:
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return None
