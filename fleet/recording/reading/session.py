"""Reading a session back: its segments, its description, every message that is whole. Nothing is repaired here.

A session is a directory (directory.py) or a bare .mcap, also somebody else's. What is whole of a file is salvage.py's.
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
    """What was named is not a session; its text names it and says why."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a session: payload bytes as they came over the bus."""

    key: str
    payload: bytes
    message: str
    """Full protobuf name; empty where the file has no schema for it."""
    encoding: str
    """MCAP message encoding: `protobuf`, `json`, or what the publisher said."""
    published_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch."""
    recorded_ns: int
    """The recorder's clock, ns since the epoch."""
    sequence: int
    """The publisher's number for the key, modulo 2^32; 0 if it gave none."""


@dataclass(slots=True)
class Session:
    """Segments in order. `damage` says what is wrong with which, as far as opening, checking or reading has seen it."""

    path: Path
    segments: tuple[Path, ...]
    """Those that can be read."""
    description: session_dir.SessionInfo | None
    damage: dict[Path, str] = field(default_factory=dict)
    unended: set[Path] = field(default_factory=set)
    """Those of which nothing is known to be wrong but that they stop somewhere, as one does that is being written."""

    @classmethod
    def open(cls, path: Path) -> Self:
        """Find a session's segments; raises NoSession."""
        try:
            whole = path.is_dir()
            there = sorted(path.glob(session_dir.SEGMENTS)) if whole else [path]
            if whole and not there:
                # Is it empty, or must we not look? Only listing it tells.
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
            if missing := sorted((numbered | _closed(path)) - set(there)):
                damage[path] = f"lacks {len(missing)} of its files, the first is {missing[0].name}"
            given = _json(path / session_dir.DESCRIPTION).get("format")
            if isinstance(given, int) and given > session_dir.FORMAT:
                raise NoSession(
                    f"{path} has format {given}, this version reads up to {session_dir.FORMAT}: "
                    "update zenoh-car-fleet; "
                    f"its files can be looked into one by one, as {there[0]}"
                )
        description = session_dir.SessionInfo.read(path) if whole else None
        return cls(path, tuple(segment for segment in there if segment not in damage), description, damage)

    @property
    def name(self) -> str:
        """What to call it: the directory's name, or the file's without its ending."""
        return self.path.resolve().name if self.path.is_dir() else self.path.stem

    def lacking(self, messages: int) -> str:
        """What its description says that there should be besides; empty if these are all, or nothing tells."""
        said = self.description.messages if self.description is not None and self.description.closed else 0
        return f"says that there were {said} messages: {said - messages} are not here" if messages < said else ""

    @property
    def damage_words(self) -> str:
        """One line on what is missing and why; empty if the session is whole."""
        return "; ".join(f"{path} {words}" for path, words in sorted(self.damage.items()))

    def check(self) -> None:
        """Look at every checksum, which reading by way of the index does not; adds what is wrong to `damage`."""
        for segment in self.segments:
            try:
                salvage = McapReader(segment)
                salvage.check()
            except NotMcap as error:  # it was one when it was opened
                self.damage[segment] = str(error)
            else:
                self._note(salvage)

    def rescue(self, out: Path) -> "Session":
        """Write every whole message into a new, whole file; it as a session. Raises OSError, and NoSession if none is.

        For what is cut or damaged: other readers stop early there, or show what fails its checksum.
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
        """Every whole message, in the order of writing; see `damage` afterwards.

        `keys`: only of these keys or key expressions (`fleet/red/**`, `fleet/*/sensor/range`). `start_ns`, `end_ns`:
        only from then until before then, by the recorder's clock. Of a whole file only the chunks are read that can
        have some, so that the last minute of a long session takes no longer than a minute's messages.
        """
        for lane, sequence, log_ns, publish_ns, data in self.rows(Selection.of(keys, start_ns, end_ns)):
            yield Recorded(
                key=lane.channel.topic,
                payload=data,
                message=message_of(lane),
                encoding=lane.channel.message_encoding,
                published_ns=publish_ns,
                recorded_ns=log_ns,
                sequence=sequence,
            )

    def rows(self, selection: Selection = EVERYTHING) -> Iterator[Row]:
        """As `messages`, as plain tuples with channel and schema as they are in the file: a third of the time."""
        for segment in self.segments:
            yield from self._whole(segment, selection)

    def expected(self) -> dict[Path, int | None]:
        """How many messages each segment should have, by its own end or what the recorder noted; None: not known."""
        counts = ((each["file"], each.get("messages")) for each in _noted(self.path))
        noted = {name: count for name, count in counts if isinstance(count, int)}
        found: dict[Path, int | None] = {}
        for segment, index in self.indexes().items():
            statistics = None if index is None else index.statistics
            found[segment] = noted.get(segment.name) if statistics is None else statistics.message_count
        gone = (path for path in self.damage if path.suffix == ".mcap" and path not in found)
        return found | {path: noted.get(path.name) for path in gone}

    def indexes(self) -> dict[Path, Index | None]:
        """What stands at the end of each segment; None where it is not whole, or cannot be read."""
        found: dict[Path, Index | None] = {}
        for segment in self.segments:
            try:
                found[segment] = McapReader(segment).index()
            except (NotMcap, OSError):
                found[segment] = None
        return found

    def _whole(self, segment: Path, selection: Selection) -> Iterator[Row]:
        try:
            salvage = McapReader(segment)
        except NotMcap as error:
            self.damage[segment] = str(error)
            return
        yield from salvage.messages(selection)
        self._note(salvage)

    def _note(self, salvage: McapReader) -> None:
        if salvage.damage:
            self.damage[salvage.path] = salvage.words
            (self.unended.add if salvage.only_cut else self.unended.discard)(salvage.path)


def _closed(path: Path) -> set[Path]:
    """The segments that the recorder noted when it closed them: of one that was last, nothing else tells."""
    return {path / one["file"] for one in _noted(path)}


def _noted(path: Path) -> list[dict[str, Any]]:
    noted = _json(path / session_dir.INDEX).get("segments") if path.is_dir() else None
    named = [one for one in noted if isinstance(one, dict)] if isinstance(noted, list) else []
    return [one for one in named if isinstance(one.get("file"), str) and fnmatch(one["file"], session_dir.SEGMENTS)]


def _json(path: Path) -> dict[str, Any]:
    """What a file says; nothing if that is no object."""
    try:
        values = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


def message_of(lane: ChannelInfo) -> str:
    """Full protobuf name of a lane's messages; empty where the file has no schema for it."""
    return lane.schema.name if lane.schema is not None and lane.schema.encoding == "protobuf" else ""
