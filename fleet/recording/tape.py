"""A session being written: which file a message goes to, what is missing, when a file, a session or the disk is full.

Called from one thread. No bus here, and no thread.
"""

import contextlib
import errno
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import zenoh

from fleet.recording import directory, room
from fleet.recording.numbers import Numbers
from fleet.recording.segment import Segment
from fleet.recording.session import NoSession, Session
from schemas.bus import sequence_of
from schemas.topics import HELD_S

MB: Final = 1_000_000
HELD_MESSAGES: Final = 100_000
HELD_BYTES: Final = 64 * MB
"""What waits while the disk is full; what comes then is dropped, and counted."""
WARN_FREE: Final = 4
"""With less than so many times `keep_free_bytes` it is told that the disk is nearly full."""
MOST_SEGMENTS: Final = 9990
"""Their names have four digits."""
LEAST_ROOM: Final = 500_000
MOST_MORE: Final = 50 * MB
"""With less than that beyond what is to stay free nothing is begun again: it would soon be full again."""
TAIL_S: Final = 3 * HELD_S
"""Of a session that was cut off: what of it publishers may still hold."""
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT} if sys.platform != "win32" else {errno.ENOSPC})


class Sync(StrEnum):
    """When the disk is waited for. What the operating system has outlives us; only its own crash loses it."""

    NEVER = "never"
    SEGMENT = "segment"
    SECOND = "second"


@dataclass(frozen=True, slots=True)
class Options:
    """How sessions are written; 0 is no limit."""

    segment_bytes: int = 512 * MB
    segment_s: float = 600.0
    """The index of an open file is in memory: of a hundred cars, 0.1 MB a second."""
    sync: Sync = Sync.SEGMENT
    session_bytes: int = 0
    """A session that has so much is closed, and the next one begins."""
    root_bytes: int = 0
    """What all sessions may have together; the oldest that nobody marked go first."""
    keep_free_bytes: int = 50 * MB
    """With less than that on the disk recording pauses."""
    copied: Mapping[str, Path] = field(default_factory=lambda: MappingProxyType({}))
    """Files that are copied into each session, by the name that they have there."""


class Lane:
    """What came under one key and encoding, in one segment."""

    __slots__ = ("channel", "count", "encoding", "final", "first", "key", "numbers")

    def __init__(self, key: str, encoding: zenoh.Encoding, numbers: Numbers, channel: int) -> None:
        self.key = key
        self.encoding = encoding
        self.numbers = numbers
        self.channel = channel
        self.count = self.first = self.final = 0


_Row = tuple[Lane, int, bytes, int, int]
"""Lane, time of receipt, payload, time of publication, number."""


class Tape:
    """Begins with a new session; raises OSError if none can be made, later also if it cannot be written.

    A full disk is not an error: `full` says so, what comes is held for a while, and it goes on when there is room.
    """

    def __init__(self, root: Path, fleet: str, options: Options, now_ns: int) -> None:
        self._root = root
        self._options = options
        self._since_ns, self._known = now_ns, frozenset[tuple[str, int, int]]()
        before = _cut_off(root, fleet, now_ns)
        self.path, self.description = directory.create(root, fleet, _wall(now_ns))
        self._about = {"fleet": fleet, "started": self.description.started, "host": self.description.host}
        self._about |= {**self.description.versions, "format": str(directory.FORMAT)}
        self.uncopied: list[str] = []
        self._copy()
        self._numbers: dict[str, Numbers] = {}
        self._odd: set[str] = set()
        """Keys whose numbers did not always follow."""
        self.gaps: set[str] = set()
        """Keys with new gaps; whoever asks for what is missing clears it."""
        self.drops: dict[str, int] = {}
        """By key: there was no room, here or on the way here. Another thread may count its own."""
        self.recovered: dict[str, int] = {}
        self.full = ""
        self.warning = ""
        self.removed: list[Path] = []
        """Old sessions that gave way; whoever tells of them clears it."""
        self._index: list[dict[str, Any]] = []
        self._written = self._closed_bytes = self._held_bytes = 0
        self._unflushed: list[_Row] = []
        self._begin(now_ns)
        if before is not None:
            self._follow(before, now_ns)

    # ------------------------------------------------------------------ messages

    def add(
        self,
        key: str,
        payload: bytes,
        encoding: zenoh.Encoding,
        stamp: zenoh.Timestamp | None,
        source: zenoh.SourceInfo | None,
        received_ns: int,
    ) -> None:
        """Write one publication as it came. This is the path of every message: each call in it costs."""
        lane = self._lanes.get(key)
        if lane is None or lane.encoding != encoding:
            lane = self._lane(key, encoding)
        published_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else received_ns
        sequence = 0
        if source is not None:
            sequence = (source.source_sn + 1) & 0xFFFFFFFF  # as sequence_of
            entity = source.source_id
            sender = (entity.zid, entity.eid)  # an EntityGlobalId itself compares by identity
            last = lane.numbers.last
            if last.get(sender) == sequence - 1:
                last[sender] = sequence
            else:
                if not lane.numbers.live(sender, sequence, published_ns):
                    return
                self._odd.add(key)
                if lane.numbers.open:
                    self.gaps.add(key)
        self._unflushed.append((lane, received_ns, payload, published_ns, sequence))
        if self._segment is None:
            self._hold()
            return
        try:
            self._put(lane.channel, received_ns, payload, published_ns, sequence)
        except OSError as error:
            self._stumble(error)

    def add_recalled(self, sample: zenoh.Sample, received_ns: int) -> None:
        """Write a publication that was asked for again, unless it is there already or older than the session."""
        source, stamp = sample.source_info, sample.timestamp
        if source is None or stamp is None:
            return
        published_ns = stamp.get_time_as_ntp64().as_nanos()
        key, sequence = str(sample.key_expr), sequence_of(source)
        if published_ns < self._since_ns:
            return
        lane = self._lanes.get(key)
        if lane is None or lane.encoding != sample.encoding:
            lane = self._lane(key, sample.encoding)
        sender = (source.source_id.zid, source.source_id.eid)
        missing = lane.numbers.missing
        if not lane.numbers.recalled(sender, sequence, published_ns) or (key, sequence, published_ns) in self._known:
            return
        self._odd.add(key)
        if lane.numbers.missing < missing:
            self.recovered[key] = self.recovered.get(key, 0) + 1
        self._write((lane, received_ns, sample.payload.to_bytes(), published_ns, sequence))

    def _write(self, row: _Row) -> None:
        self._unflushed.append(row)
        if self._segment is None:
            self._hold()
            return
        try:
            self._put(row[0].channel, *row[1:])
        except OSError as error:
            self._stumble(error)

    def _lane(self, key: str, encoding: zenoh.Encoding) -> Lane:
        """The lane of a key and an encoding; a key has another one only if its encoding changes."""
        words = str(encoding)
        lane = self._others.get((key, words))
        if lane is None:
            channel = -1
            if self._segment is not None:
                try:
                    channel = self._segment.channel(key, words)
                except OSError as error:
                    self._stumble(error)
            lane = Lane(key, encoding, self._numbers.setdefault(key, Numbers()), channel)
            self._others[key, words] = lane
        self._lanes[key] = lane
        return lane

    # ------------------------------------------------------------------ what there is

    @property
    def messages(self) -> int:
        """How many are written, or wait for room."""
        return self._written + len(self._unflushed)

    @property
    def bytes(self) -> int:
        """What the segments have, as far as it is certain."""
        return self._closed_bytes + (0 if self._segment is None else self._segment.bytes)

    @property
    def segments(self) -> int:
        """How many files there are."""
        return len(self._index) + (self._segment is not None)

    @property
    def missed(self) -> dict[str, int]:
        """By key: how many publications are missing, by their publishers' numbers."""
        return {key: missing for key in sorted(self._odd) if (missing := self._numbers[key].missing)}

    @property
    def over(self) -> bool:
        """Whether the session has all that it may have."""
        return 0 < self._options.session_bytes <= self.bytes or self.segments >= MOST_SEGMENTS

    # ------------------------------------------------------------------ each second, and the end

    def tick(self, now_ns: int) -> None:
        """Make certain what has come, begin the next segment if it is time, look at the disk."""
        if self._segment is None:
            self._resume(now_ns)
            return
        try:
            self._segment.flush(sync=self._options.sync is Sync.SECOND)
            self._count()
            segment_s = self._options.segment_s
            late = bool(segment_s) and now_ns - self._begun_ns >= segment_s * 1e9
            if late or 0 < self._options.segment_bytes <= self._segment.bytes:
                self._finish()
                self._begin(now_ns)
        except OSError as error:
            self._stumble(error)
        self._look()

    def mark(self, text: str, by: str, now_ns: int) -> None:
        """Note a mark, and that the session is to be kept; raises OSError."""
        marks = [*self.description.marks, {"time": directory.iso(_wall(now_ns)), "text": text, "by": by}]
        self.description.marks, self.description.kept = marks, True
        self.description.write(self.path)

    def close(self, now_ns: int) -> None:
        """Write what there is, and end the session; what finds no room even now is counted as dropped."""
        if self._segment is None:
            self._resume(now_ns)
        try:
            if self._segment is not None:
                self._segment.flush()
                self._count()
                self._finish()
        except OSError as error:
            self._stumble(error)
        for lane, *_ in self._unflushed:
            self._drop(lane.key)
        self._unflushed.clear()
        self._describe(now_ns, closed=True)

    def abandon(self, words: str, now_ns: int) -> None:
        """End a session that cannot be written any more; what was flushed stays as it is."""
        self.description.error = words
        if self._segment is not None:
            self._segment.cut()
        with contextlib.suppress(OSError):  # the disk that failed; said already
            self._describe(now_ns, closed=False)

    # ------------------------------------------------------------------ segments

    def _begin(self, now_ns: int) -> None:
        self._lanes: dict[str, Lane] = {}
        self._others: dict[tuple[str, str], Lane] = {}
        self._begun_ns, self._first_ns, self._last_ns = now_ns, 0, 0
        self._segment: Segment | None = None
        path = directory.segment(self.path, len(self._index) + 1)
        try:
            self._segment = Segment(path, self._about)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        self._put = self._segment.add

    def _count(self) -> None:
        """What was flushed, for the index."""
        rows = self._unflushed
        if not rows:
            return
        first_ns, last_ns = rows[0][1], rows[-1][1]
        if last_ns - first_ns < 0 or first_ns < self._last_ns:  # the clock went back
            first_ns, last_ns = min(row[1] for row in rows), max(row[1] for row in rows)
        self._first_ns = min(self._first_ns or first_ns, first_ns)
        self._last_ns = max(self._last_ns, last_ns)
        for lane, _, _, _, sequence in rows:
            if not lane.count:
                lane.first = sequence
            lane.count += 1
            lane.final = sequence
        self._written += len(rows)
        self._unflushed = []

    def _finish(self) -> None:
        assert self._segment is not None
        lost = {"drops": dict(self.drops), "missed": self.missed, "recovered": self.recovered}
        self._segment.finish({"messages": self._written, **lost}, sync=self._options.sync is not Sync.NEVER)
        self._ended()

    def _ended(self) -> None:
        """Note what the segment has; it takes no more."""
        assert self._segment is not None
        counts: dict[str, dict[str, int]] = {}
        for lane in self._others.values():
            if lane.count:
                known = counts.setdefault(lane.key, {"count": 0, "first": lane.first, "last": 0})
                known["count"] += lane.count
                known["last"] = lane.final
        entry = {"file": self._segment.path.name, "bytes": self._segment.bytes, "keys": counts}
        entry |= {"first_ns": self._first_ns, "last_ns": self._last_ns}
        self._index.append({**entry, "messages": sum(each["count"] for each in counts.values())})
        self._closed_bytes += self._segment.bytes
        self._segment = None
        with contextlib.suppress(OSError):  # a cache, and a description that is written again at the end
            directory.replace(self.path / directory.INDEX, {"segments": self._index})
            self._describe(None, closed=False)

    # ------------------------------------------------------------------ room

    def _stumble(self, error: OSError) -> None:
        """What was not flushed is held; anything but a full disk is raised."""
        if error.errno not in _FULL:
            raise error
        if self._segment is not None:
            self._segment.cut()
            self._ended()
        self._pause(f"{error.strerror or error}")

    def _pause(self, words: str) -> None:
        self.full = f"{self._root}: {words}: nothing is written until there is room"
        self.description.error = self.full
        self._held_bytes = sum(len(row[2]) for row in self._unflushed)

    def _hold(self) -> None:
        """Whether what came last can wait for room."""
        lane, _, payload, _, _ = self._unflushed[-1]
        if len(self._unflushed) > HELD_MESSAGES or self._held_bytes + len(payload) > HELD_BYTES:
            self._unflushed.pop()
            self._drop(lane.key)
        else:
            self._held_bytes += len(payload)

    def _drop(self, key: str) -> None:
        self.drops[key] = self.drops.get(key, 0) + 1

    def _look(self) -> None:
        """See whether there is room, and make some among the old sessions."""
        keep, limit = self._options.keep_free_bytes, self._options.root_bytes
        self.warning = ""
        if limit:
            removed, over = room.make_room(self._root, limit, self.path)
            self.removed += removed
            if over:
                more = f"{self._root} has {over / MB:.1f} MB more than its quota"
                self.warning = f"{more}, all of it marked, in use or not to be removed"
        free = room.free_bytes(self.path)
        if free < keep * WARN_FREE:
            self.warning = f"{self._root}: the disk is nearly full, {free / MB:.0f} MB are left"
        if free < keep and self._segment is not None:
            try:
                self._finish()
            except OSError as error:
                self._stumble(error)
                return
            self._pause(f"{free / MB:.1f} MB are left on the disk, {keep / MB:g} MB are to stay free")

    def _resume(self, now_ns: int) -> None:
        keep = self._options.keep_free_bytes
        if room.free_bytes(self.path) < keep + max(min(keep, MOST_MORE), LEAST_ROOM):
            return
        rows, self._unflushed = self._unflushed, []
        try:
            self._begin(now_ns)
        except OSError as error:
            self._unflushed = rows
            self._stumble(error)
            return
        self.full = ""
        for lane, received_ns, payload, published_ns, sequence in rows:
            self._write((self._lane(lane.key, lane.encoding), received_ns, payload, published_ns, sequence))

    # ------------------------------------------------------------------ the directory

    def _copy(self) -> None:
        for name, source in self._options.copied.items():
            try:
                shutil.copyfile(source, self.path / name)
            except OSError as error:  # no reason to record nothing
                self.uncopied.append(f"{source} could not be copied into {self.path}: {error.strerror}")
        if self.uncopied:
            self.description.error = "; ".join(self.uncopied)
            self.description.write(self.path)

    def _describe(self, now_ns: int | None, *, closed: bool) -> None:
        description = self.description
        if now_ns is not None:
            description.ended, description.closed = directory.iso(_wall(now_ns)), closed
        description.messages = self.messages
        description.drops, description.missed = dict(self.drops), self.missed
        description.recovered = dict(self.recovered)
        description.write(self.path)

    def _follow(self, before: Session, now_ns: int) -> None:
        """Go on where a recorder was killed: what it has is not written again, what it has not is."""
        start_ns = now_ns - int(TAIL_S * 1e9)
        # Killed again before it had what the one before it lacked, it lacks that still.
        chain = [before, *_continued(before, start_ns)]
        self._known = frozenset(
            (each.key, each.sequence, each.published_ns)
            for session in chain
            for each in session.messages(start_ns=start_ns)
        )
        self._since_ns = max(start_ns, _begun_ns(chain[-1]))
        self.description.continues = before.path.name
        self.description.write(self.path)


def _wall(now_ns: int) -> datetime:
    return datetime.fromtimestamp(now_ns / 1e9, UTC)


def _continued(session: Session, start_ns: int) -> list[Session]:
    """The sessions that one goes on with, the latest first, back to the one in which `start_ns` lies."""
    found = [session]
    while _begun_ns(found[-1]) > start_ns:
        description = found[-1].description
        assert description is not None
        name = description.continues
        if not name or Path(name).name != name:
            break
        try:
            earlier = Session.open(session.path.parent / name)
        except NoSession:
            break
        if earlier.description is None or earlier.path in [each.path for each in found]:
            break
        found.append(earlier)
    return found[1:]


def _begun_ns(session: Session) -> int:
    assert session.description is not None
    return int(datetime.fromisoformat(session.description.started).timestamp() * 1e9)


def _cut_off(root: Path, fleet: str, now_ns: int) -> Session | None:
    """The session of a recorder that ended a moment ago without closing it; None if there is none."""
    there = sorted(root.glob(f"*/{directory.DESCRIPTION}"), key=lambda path: path.parent.name)
    for path in reversed(there):
        description = directory.Description.read(path.parent)
        if description is None or description.fleet != fleet:
            continue
        if description.closed or description.ended is not None:
            return None
        try:
            session = Session.open(path.parent)
            written_ns = session.segments[-1].stat().st_mtime_ns
        except (NoSession, OSError):
            return None
        return session if now_ns - written_ns < HELD_S * 2e9 else None
    return None
