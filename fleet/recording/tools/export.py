"""A session as tables in a directory, one file for each type of message. How tables look is tables.py's."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from google.protobuf.message import DecodeError, Message

from fleet.recording.reading.mcap_reader import ChannelInfo, Row
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import message_of
from fleet.recording.tools import tables
from fleet.recording.tools.table_formats import Sink

BATCH_BYTES: Final = 4 << 20
"""What waits of one table until it is written: payloads, and ROW_BYTES for each row."""
ROW_BYTES: Final = 256
OTHER: Final = "other"


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written."""

    rows: Mapping[str, int]
    """By file name."""
    undecoded: int
    """Messages with a protobuf schema that they do not fit: among the others, as bytes."""


@dataclass(slots=True)
class _Waiting:
    """Messages that wait for their table, by column: of a row each, the garbage collector would take a third longer."""

    lanes: list[ChannelInfo] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)

    def part(self, numbers: Sequence[int]) -> "_Waiting":
        """Some of them."""
        columns = (self.lanes, self.log_ns, self.publish_ns, self.sequences, self.payloads)
        return _Waiting(*([column[number] for number in numbers] for column in columns))  # type: ignore[arg-type]  # in turn

    def extend(self, others: "_Waiting") -> None:
        """Add them all."""
        self.lanes += others.lanes
        self.log_ns += others.log_ns
        self.publish_ns += others.publish_ns
        self.sequences += others.sequences
        self.payloads += others.payloads

    def common(self) -> list[tables.Values]:
        """The values of the columns that every table has."""
        topics = [lane.channel.topic for lane in self.lanes]
        cars = {key: tables.car_of(key) for key in set(topics)}
        return [topics, [cars[key] for key in topics], self.log_ns, self.publish_ns, self.sequences]

    def others(self) -> list[tables.Values]:
        """The values of the columns of what is no protobuf message."""
        texts = [_text(payload) for payload in self.payloads]
        return [
            [message_of(lane) or None for lane in self.lanes],
            [lane.channel.message_encoding for lane in self.lanes],
            texts,
            [None if text is not None else data for data, text in zip(self.payloads, texts, strict=True)],
        ]


@dataclass(slots=True)
class _Table:
    """One file, and what waits for it."""

    sink: Sink
    layout: tables.Layout | None
    made: type[Message] | None
    name: str
    waiting: _Waiting = field(default_factory=_Waiting)
    size: int = 0
    rows: int = 0

    def write(self) -> _Waiting:
        """Write what waits; what of it is not the message that it should be is left out and returned."""
        batch, self.waiting, self.size = self.waiting, _Waiting(), 0
        bad = _Waiting()
        messages: list[Message] = []
        if self.made is not None:
            try:
                messages = list(map(self.made.FromString, batch.payloads))
            except DecodeError:
                batch, bad, messages = _sorted_out(batch, self.made)
        if batch.lanes:
            own = self.layout.fill(messages) if self.layout is not None else batch.others()
            self.sink.add([*batch.common(), *own])
            self.rows += len(batch.lanes)
        return bad


def _sorted_out(batch: _Waiting, made: type[Message]) -> tuple[_Waiting, _Waiting, list[Message]]:
    good: list[int] = []
    bad: list[int] = []
    messages: list[Message] = []
    for number, payload in enumerate(batch.payloads):
        try:
            messages.append(made.FromString(payload))
        except DecodeError:
            bad.append(number)
        else:
            good.append(number)
    return batch.part(good), batch.part(bad), messages


class _Export:
    """The tables of a session, as far as they have been met."""

    def __init__(self, out: Path, sink: type[Sink]) -> None:
        self._out = out
        self._sink = sink
        self._decoder = MessageDecoder()
        self._by_lane: dict[int, tuple[ChannelInfo, _Table]] = {}
        self.tables: dict[type[Message] | None, _Table] = {}
        self.undecoded = 0

    def run(self, rows: Iterable[Row]) -> None:
        """Write every message."""
        by_lane = self._by_lane
        for lane, sequence, log_ns, publish_ns, payload in rows:
            # By identity, which is quick; the lane is kept with it, so that no other can have the same.
            known = by_lane.get(id(lane))
            if known is None:
                known = by_lane[id(lane)] = (lane, self._of(self._decoder.class_of(lane)))
            table = known[1]
            waiting = table.waiting
            waiting.lanes.append(lane)
            waiting.log_ns.append(log_ns)
            waiting.publish_ns.append(publish_ns)
            waiting.sequences.append(sequence)
            waiting.payloads.append(payload)
            table.size += len(payload) + ROW_BYTES
            if table.size >= BATCH_BYTES:
                self._write(table)
        for table in list(self.tables.values()):
            self._write(table)
        if None in self.tables:
            self.tables[None].write()

    def _write(self, table: _Table) -> None:
        bad = table.write()
        self.undecoded += len(bad.lanes)
        if bad.lanes:
            self._of(None).waiting.extend(bad)

    def _of(self, made: type[Message] | None) -> _Table:
        if made not in self.tables:
            self.tables[made] = self._opened(made)
        return self.tables[made]

    def _opened(self, made: type[Message] | None) -> _Table:
        """A new file; a second type of the same name, whose fields changed within the session, has a number."""
        name = made.DESCRIPTOR.full_name if made is not None else OTHER
        stem = re.sub(r"[^A-Za-z0-9._-]", "_", name)
        taken = {table.name.lower() for table in self.tables.values()}
        file = next(one for one in _names(stem, self._sink.ending) if one.lower() not in taken)
        layout = tables.Layout(made.DESCRIPTOR) if made is not None else None
        sink = self._sink(self._out / file, layout.columns if layout is not None else tables.OTHER)
        return _Table(sink, layout, made, file)

    def close(self) -> None:
        """End every file."""
        for table in self.tables.values():
            table.sink.close()


def export(rows: Iterable[Row], out: Path, sink: type[Sink]) -> Exported:
    """Write the tables of messages into a directory that is there; raises OSError, FormatMissing."""
    writing = _Export(out, sink)
    try:
        writing.run(rows)
    finally:
        writing.close()
    return Exported({table.name: table.rows for table in writing.tables.values()}, writing.undecoded)


def _names(stem: str, ending: str) -> Iterator[str]:
    yield f"{stem}{ending}"
    number = 2
    while True:
        yield f"{stem}-{number}{ending}"
        number += 1


def _text(payload: bytes) -> str | None:
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return None
