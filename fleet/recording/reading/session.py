"""Reads a session: its segments, its description and every intact message. Repairs nothing.

A session is a directory (session_dir.py) or a single .mcap file of any writer. mcap_reader.py reads the files.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Self

from fleet.recording import session_dir
from fleet.recording.reading.mcap_index import Index
from fleet.recording.reading.mcap_reader import ChannelInfo, McapReader, NotMcap, Row
from fleet.recording.selection import EVERYTHING, Selection
from fleet.recording.writing.mcap_copy import Copy


class NoSession(Exception):
    """The path is no session. The message names the path and the reason."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a session, with its payload as on the bus."""

    key: str
    payload: bytes
    message: str
    """Full protobuf name; empty if the file has no schema for it."""
    encoding: str
    """MCAP message encoding: `protobuf`, `json`, or the encoding of the publisher."""
    published_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch."""
    recorded_ns: int
    """Time of the recorder's clock, ns since the epoch."""
    sequence: int
    """Sequence number of the publisher for the key, modulo 2^32; 0 if it sent none."""


@dataclass(slots=True)
class Session:
    """Segments in order, and their `damage` found so far by opening, checking or reading."""

    path: Path
    segments: tuple[Path, ...]
    """Readable segments."""
    description: session_dir.SessionInfo | None
    damage: dict[Path, str] = field(default_factory=dict)
    unended: set[Path] = field(default_factory=set)
    """Segments that are only truncated, as a file still being written is."""

    @classmethod
    def open(cls, path: Path) -> Self:
        """Find the segments of a session; raises NoSession."""
        try:
            whole = path.is_dir()
            there = sorted(path.glob(session_dir.SEGMENTS)) if whole else [path]
            if whole and not there:
                # Glob hides a missing permission. Listing the directory raises it.
                next(path.iterdir(), None)
                raise NoSession(f"{path} is not a session: no {session_dir.segment(Path(), 1)} in it")
            if not whole and not path.exists():
                raise NoSession(
                    f"there is no session at {path}: name the directory that `fleet record` printed, or an .mcap"
                )
        except OSError as error:
            raise NoSession(f"{path} cannot be read: {error.strerror}") from None
        damage = {}
        for segment in there:
            try:
                McapReader(segment)
            except NotMcap as error:
                damage[segment] = str(error)
        if len(damage) == len(there):
            raise NoSession("; ".join(f"{segment} {words}" for segment, words in damage.items()))
        if whole:
            numbered = {session_dir.segment(path, number + 1) for number in range(int(there[-1].stem))}
            if missing := sorted((numbered | _closed_segments(path)) - set(there)):
                damage[path] = f"lacks {len(missing)} of its files, the first is {missing[0].name}"
            given = _json(path / session_dir.SESSION_FILE).get("format")
            if isinstance(given, int) and given > session_dir.FORMAT_VERSION:
                raise NoSession(
                    f"{path} has format {given}, this version reads up to {session_dir.FORMAT_VERSION}: "
                    "update zenoh-car-fleet; "
                    f"its files can be looked into one by one, as {there[0]}"
                )
        description = session_dir.SessionInfo.read(path) if whole else None
        return cls(path, tuple(segment for segment in there if segment not in damage), description, damage)

    @property
    def name(self) -> str:
        """Return the name of the directory, or of the file without its suffix."""
        return self.path.resolve().name if self.path.is_dir() else self.path.stem

    def lacking(self, messages: int) -> str:
        """Return which messages session.json counts beyond these, in words; empty if none or unknown."""
        total = self.description.messages if self.description is not None and self.description.closed else 0
        return f"says that there were {total} messages: {total - messages} are not here" if messages < total else ""

    @property
    def damage_words(self) -> str:
        """Return the damage on one line; empty if there is none."""
        return "; ".join(f"{path} {words}" for path, words in sorted(self.damage.items()))

    def check(self) -> None:
        """Check every CRC, also those that reading skips, and add failures to `damage`."""
        for segment in self.segments:
            try:
                reader = McapReader(segment)
                reader.check()
            except NotMcap as error:  # replaced since it was opened
                self.damage[segment] = str(error)
            else:
                self._add_damage(reader)

    def rescue(self, out: Path) -> "Session":
        """Copy every intact message into a new file, and return it as a session. Raises OSError, NoSession if empty.

        For truncated or damaged files: other readers stop at the damage, or show corrupted messages.
        """
        with Copy(out) as copy:
            for row in self.rows():
                copy.add(row)
        if not copy.messages:
            raise NoSession(f"{self.path} holds no message that is whole: {self.damage_words}")
        return Session(self.path, (out,), self.description)

    def messages(
        self, keys: Iterable[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Recorded]:
        """Yield every intact message in the order of the file; see `damage` afterwards.

        `keys` selects keys or key expressions (`fleet/red/**`, `fleet/*/sensor/range`). `start_ns` (included) and
        `end_ns` (excluded) select times of the recorder's clock. With an index only chunks in question are read: the
        last minute of a long session takes no longer than a minute's messages.
        """
        for info, sequence, log_ns, publish_ns, data in self.rows(Selection.of(keys, start_ns, end_ns)):
            yield Recorded(
                key=info.channel.topic,
                payload=data,
                message=message_of(info),
                encoding=info.channel.message_encoding,
                published_ns=publish_ns,
                recorded_ns=log_ns,
                sequence=sequence,
            )

    def rows(self, selection: Selection = EVERYTHING) -> Iterator[Row]:
        """Yield messages as plain tuples with their channel and schema: a third of the time of `messages`."""
        for segment in self.segments:
            yield from self._read_segment(segment, selection)

    def expected(self) -> dict[Path, int | None]:
        """Return the expected messages of each segment, from its index or index.json; None if unknown."""
        counts = ((each["file"], each.get("messages")) for each in _indexed_segments(self.path))
        indexed = {name: count for name, count in counts if isinstance(count, int)}
        found: dict[Path, int | None] = {}
        for segment, index in self.indexes().items():
            statistics = None if index is None else index.statistics
            found[segment] = indexed.get(segment.name) if statistics is None else statistics.message_count
        gone = (path for path in self.damage if path.suffix == ".mcap" and path not in found)
        return found | {path: indexed.get(path.name) for path in gone}

    def indexes(self) -> dict[Path, Index | None]:
        """Return the index of each segment; None if it is damaged or cannot be read."""
        found: dict[Path, Index | None] = {}
        for segment in self.segments:
            try:
                found[segment] = McapReader(segment).index()
            except (NotMcap, OSError):
                found[segment] = None
        return found

    def _read_segment(self, segment: Path, selection: Selection) -> Iterator[Row]:
        try:
            reader = McapReader(segment)
        except NotMcap as error:
            self.damage[segment] = str(error)
            return
        yield from reader.messages(selection)
        self._add_damage(reader)

    def _add_damage(self, reader: McapReader) -> None:
        if reader.damage:
            self.damage[reader.path] = reader.words
            (self.unended.add if reader.only_cut else self.unended.discard)(reader.path)


def _closed_segments(path: Path) -> set[Path]:
    """Return the segments listed in index.json, which alone shows that the last one is missing."""
    return {path / one["file"] for one in _indexed_segments(path)}


def _indexed_segments(path: Path) -> list[dict[str, Any]]:
    indexed = _json(path / session_dir.INDEX_FILE).get("segments") if path.is_dir() else None
    named = [one for one in indexed if isinstance(one, dict)] if isinstance(indexed, list) else []
    return [one for one in named if isinstance(one.get("file"), str) and fnmatch(one["file"], session_dir.SEGMENTS)]


def _json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; empty if there is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


def message_of(info: ChannelInfo) -> str:
    """Return the full protobuf name of the messages of a channel; empty if the file has no schema for it."""
    return info.schema.name if info.schema is not None and info.schema.encoding == "protobuf" else ""
