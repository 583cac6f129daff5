"""A session as tables in a directory, one file for each type of message. How tables look is tables.py's."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from google.protobuf.message import DecodeError, Message

from fleet.recording.decoding import Decoder
from fleet.recording.salvage import Lane, Row
from fleet.recording.session import Session, message_of
from fleet.recording.sessions import tables
from fleet.recording.sessions.formats import Sink

BATCH_ROWS: Final = 16_384
BATCH_BYTES: Final = 4 << 20
"""What waits of one table until it is written."""
OTHER: Final = "other"


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written."""

    rows: Mapping[str, int]
    """By file name."""
    undecoded: int
    """Messages with a protobuf schema that they do not fit: among the others, as bytes."""


@dataclass(slots=True)
class _Table:
    """One file, and what waits for it."""

    sink: Sink
    layout: tables.Layout | None
    made: type[Message] | None
    name: str
    waiting: list[Row] = field(default_factory=list)
    size: int = 0
    rows: int = 0

    def write(self) -> list[Row]:
        """Write what waits; what of it is not the message that it should be is left out and returned."""
        rows, self.waiting, self.size = self.waiting, [], 0
        bad: list[Row] = []
        messages: list[Message] = []
        if self.made is not None:
            try:
                messages = list(map(self.made.FromString, [row[4] for row in rows]))
            except DecodeError:
                rows, bad, messages = _sorted_out(rows, self.made)
        if rows:
            own = self.layout.fill(messages) if self.layout is not None else _others(rows)
            self.sink.add([*_common(rows), *own])
            self.rows += len(rows)
        return bad


def _sorted_out(rows: Iterable[Row], made: type[Message]) -> tuple[list[Row], list[Row], list[Message]]:
    good: list[Row] = []
    bad: list[Row] = []
    messages: list[Message] = []
    for row in rows:
        try:
            messages.append(made.FromString(row[4]))
        except DecodeError:
            bad.append(row)
        else:
            good.append(row)
    return good, bad, messages


def _common(rows: Sequence[Row]) -> list[tables.Values]:
    topics = [row[0].channel.topic for row in rows]
    cars = {key: tables.car_of(key) for key in set(topics)}
    return [
        topics,
        [cars[key] for key in topics],
        [row[2] for row in rows],
        [row[3] for row in rows],
        [row[1] for row in rows],
    ]


def _others(rows: Sequence[Row]) -> list[tables.Values]:
    texts = [_text(row[4]) for row in rows]
    return [
        [message_of(row[0]) or None for row in rows],
        [row[0].channel.message_encoding for row in rows],
        texts,
        [None if text is not None else row[4] for row, text in zip(rows, texts, strict=True)],
    ]


class _Export:
    """The tables of a session, as far as they have been met."""

    def __init__(self, out: Path, sink: type[Sink]) -> None:
        self._out = out
        self._sink = sink
        self._decoder = Decoder()
        self._by_lane: dict[int, tuple[Lane, _Table]] = {}
        self.tables: dict[type[Message] | None, _Table] = {}
        self.undecoded = 0

    def run(self, rows: Iterable[Row]) -> None:
        """Write every message."""
        by_lane = self._by_lane
        for row in rows:
            # By identity, which is quick; the lane is kept with it, so that no other can have the same.
            known = by_lane.get(id(row[0]))
            if known is None:
                known = by_lane[id(row[0])] = (row[0], self._of(self._decoder.class_of(row[0])))
            table = known[1]
            table.waiting.append(row)
            table.size += len(row[4])
            if len(table.waiting) >= BATCH_ROWS or table.size >= BATCH_BYTES:
                self._write(table)
        for table in list(self.tables.values()):
            self._write(table)
        if None in self.tables:
            self.tables[None].write()

    def _write(self, table: _Table) -> None:
        bad = table.write()
        self.undecoded += len(bad)
        if bad:
            self._of(None).waiting += bad

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


def total(session: Session) -> int | None:
    """How many messages the indexes say that there are; None where one is missing."""
    count = 0
    for index in session.indexes().values():
        if index is None or index.statistics is None:
            return None
        count += index.statistics.message_count
    return count
