"""A session being written: which file a message goes to, what is missing, when a file, a session or the disk is full.

Called from one thread. No bus here, and no thread.
"""

import contextlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import zenoh

from fleet.recording import session_dir
from fleet.recording.sequence_tracker import SequenceTracker
from fleet.recording.writing import resume, retention
from fleet.recording.writing.segment_writer import Segment
from schemas.bus import sequence_of

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
END_ROOM: Final = 200_000
"""With less than that on the disk not even the end of a session is written: a file's index is to have room."""
BATCH: Final = 100_000
"""Bytes: of what waited so much is written, and certain, before there is another look at the room."""
SHARE: Final = 10
"""A quota is kept by removing whole sessions, so one has no more than a tenth of it."""


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
    """A session that has so much is closed, and the next one begins; 0: a tenth of `root_bytes`."""
    root_bytes: int = 0
    """What all sessions may have together; the oldest that nobody marked go first."""
    keep_free_bytes: int = 50 * MB
    """With less than that on the disk recording pauses."""
    copied: Mapping[str, Path] = field(default_factory=lambda: MappingProxyType({}))
    """Files that are copied into each session, by the name that they have there."""

    @property
    def session_limit(self) -> int:
        """What one session may have, bytes; 0 is no limit."""
        return self.session_bytes or self.root_bytes // SHARE


class KeyState:
    """What came under one key and encoding, in one segment."""

    __slots__ = ("channel", "count", "encoding", "final", "first", "key", "numbers")

    def __init__(self, key: str, encoding: zenoh.Encoding, numbers: SequenceTracker, channel: int) -> None:
        self.key = key
        self.encoding = encoding
        self.numbers = numbers
        self.channel = channel
        self.count = self.first = self.final = 0


_Row = tuple[KeyState, int, bytes, int, int]
"""Lane, time of receipt, payload, time of publication, number."""


class SessionWriter:
    """Begins with a new session; raises OSError if none can be made, later also if it cannot be written.

    A full disk is not an error: `full` says so, what comes is held for a while, and it goes on when there is room.
    If it is full from the start, `path` is where the session will be.
    """

    def __init__(self, root: Path, fleet: str, options: Options, now_ns: int) -> None:
        self._root = root
        self._options = options
        self.path, self.description = session_dir.plan(root, fleet, _wall(now_ns))
        self._made = False
        follows = resume.cut_off(root, fleet, now_ns)
        self.description.continues = follows.name
        self._since_ns, self._known = follows.since_ns, follows.known
        self._about = {"fleet": fleet, "started": self.description.started, "host": self.description.host}
        self._about |= {**self.description.versions, "format": str(session_dir.FORMAT)}
        self.uncopied: list[str] = []
        """Whoever tells of them clears it."""
        self._numbers: dict[str, SequenceTracker] = {}
        self._odd: set[str] = set()
        """Keys whose numbers did not always follow."""
        self.gaps: set[str] = set()
        """Keys with new gaps; whoever asks for what is missing clears it."""
        self.drops: dict[str, int] = {}
        """By key: there was no room, here or on the way here. Another thread may count its own."""
        self.recovered: dict[str, int] = {}
        self.full = ""
        self.cost = ""
        """What the end of the session cost for want of room."""
        self.warning = ""
        self.removed: list[Path] = []
        """Old sessions that gave way; whoever tells of them clears it."""
        self._index: list[dict[str, Any]] = []
        self._written = self._closed_bytes = self._held_bytes = 0
        self._unflushed: list[_Row] = []
        self._forget_lanes(now_ns)
        self._open(now_ns, self._options.keep_free_bytes + LEAST_ROOM)

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

    def _lane(self, key: str, encoding: zenoh.Encoding) -> KeyState:
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
            lane = KeyState(key, encoding, self._numbers.setdefault(key, SequenceTracker()), channel)
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
    def waiting(self) -> int:
        """How many wait for room; 0 while there is some."""
        return len(self._unflushed) if self.full else 0

    @property
    def free_bytes(self) -> int:
        """What is free on the disk; raises OSError."""
        return retention.free_bytes(self.path) if self._made else retention.free_bytes_for(self._root)

    @property
    def missed(self) -> dict[str, int]:
        """By key: how many publications are missing, by their publishers' numbers."""
        return {key: missing for key in sorted(self._odd) if (missing := self._numbers[key].missing)}

    @property
    def over(self) -> bool:
        """Whether the session has all that it may have."""
        return 0 < self._options.session_limit <= self.bytes or self.segments >= MOST_SEGMENTS

    # ------------------------------------------------------------------ each second, and the end

    def tick(self, now_ns: int) -> None:
        """Make certain what has come, begin the next segment if it is time, look at the disk."""
        if self._segment is None:
            self._resume(now_ns)
            return
        try:
            self._flush(sync=self._options.sync is Sync.SECOND)
            segment_s = self._options.segment_s
            late = bool(segment_s) and now_ns - self._begun_ns >= segment_s * 1e9
            if (late or 0 < self._options.segment_bytes <= self._segment.bytes) and not self.over:
                self._finish()
                if not self.over:  # its index counts, too
                    self._begin(now_ns)
        except OSError as error:
            self._stumble(error)
        self._look()

    def mark(self, text: str, by: str, now_ns: int) -> None:
        """Note a mark, and that the session is to be kept; raises OSError."""
        marks = [*self.description.marks, {"time": session_dir.iso(_wall(now_ns)), "text": text, "by": by}]
        self.description.marks, self.description.kept = marks, True
        if self._made:
            self.description.write(self.path)

    def close(self, now_ns: int) -> None:
        """Write what there is, and end the session, also where room was to stay free.

        What finds none even now is counted as dropped, and `cost` says it.
        """
        try:
            self._flush()
        except OSError as error:
            self._stumble(error)
        dropped = 0
        if self._segment is None and self._unflushed and self._open(now_ns, END_ROOM):
            dropped = self._drop_all(self._write_held(END_ROOM))
        try:
            if self._segment is not None:
                self._finish()
        except OSError as error:
            self._stumble(error)
            self.cost = "there was no room for the end of the last file, whose messages are all there"
        if dropped := dropped + self._drop_waiting():
            self.cost = f"there was no room to the end: {dropped} messages that waited for it are dropped"
        if self.cost:
            self.description.error = self.cost = f"{self._root}: {self.cost}"
        if self._made:
            try:
                self._describe(now_ns, closed=True)
            except OSError as error:
                if not session_dir.is_full(error):
                    raise
                self.cost = f"{self.cost or self._root}; session.json there has no room to say so"
            session_dir.release(self.path)

    def abandon(self, why: str, now_ns: int) -> str:
        """End a session that cannot be written any more; what was flushed stays as it is. The whole story in words."""
        if self._segment is not None:
            self._segment.cut()
        self._drop_waiting()
        dropped = sum(self.drops.values())
        words = f"{why}. What was written until then is whole: {self._written} messages; {dropped} are dropped"
        self.description.error = words
        with contextlib.suppress(OSError):  # the disk that failed; said already
            self._describe(now_ns, closed=False)
            session_dir.release(self.path)
        return words

    # ------------------------------------------------------------------ segments

    def _open(self, now_ns: int, room_bytes: int) -> bool:
        """Begin a file, and before the first one the session; False, and paused, if there is no such room."""
        free = self.free_bytes
        if self._unflushed:  # or a file would be begun for a large one again and again
            room_bytes += len(self._unflushed[0][2])
        if free < room_bytes:
            if not self.full:
                self._pause(f"{free / MB:.1f} MB are left on the disk, {room_bytes / MB:.1f} MB are needed")
            return False
        made = self._made
        try:
            if not made:
                self.path = session_dir.create(self.path, self.description)
                self._made = True
            self._begin(now_ns)
        except OSError as error:
            if self._made and not made:  # a session without a file is none
                shutil.rmtree(self.path, ignore_errors=True)
                self._made = False
            self._stumble(error)
            return False
        if not made:
            self._copy()
        with contextlib.suppress(OSError):
            session_dir.reserve(self.path)
        self.full = ""
        return True

    def _forget_lanes(self, now_ns: int) -> None:
        self._lanes: dict[str, KeyState] = {}
        self._others: dict[tuple[str, str], KeyState] = {}
        self._begun_ns, self._first_ns, self._last_ns = now_ns, 0, 0
        self._segment: Segment | None = None

    def _begin(self, now_ns: int) -> None:
        self._forget_lanes(now_ns)
        path = session_dir.segment(self.path, len(self._index) + 1)
        try:
            self._segment = Segment(path, self._about)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        self._put = self._segment.add

    def _flush(self, *, sync: bool = False) -> None:
        """Make certain what has come."""
        if self._segment is not None:
            self._segment.flush(sync=sync)
            self._count()

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
            session_dir.replace(self.path / session_dir.INDEX, {"segments": self._index})
            self._describe(None, closed=False)

    # ------------------------------------------------------------------ room

    def _stumble(self, error: OSError) -> None:
        """What was not flushed is held; anything but a full disk is raised."""
        if not session_dir.is_full(error):
            raise error
        if self._segment is not None:
            self._segment.cut()
            if self._index and not any(lane.count for lane in self._others.values()):
                self._segment.path.unlink(missing_ok=True)  # nothing is in it
                self._segment = None
            else:
                self._ended()
        self._pause(f"{error.strerror or error}")

    def _pause(self, words: str) -> None:
        self.full = f"{self._root}: {words}: nothing is written until there is room"
        self.description.error = self.full
        self._held_bytes = sum(len(row[2]) for row in self._unflushed)
        if self._made:
            with contextlib.suppress(OSError):  # it is told on the bus, and written at the end
                self._describe(None, closed=False)

    def _hold(self) -> None:
        """Whether what came last can wait for room."""
        lane, _, payload, _, _ = self._unflushed[-1]
        if len(self._unflushed) > HELD_MESSAGES or self._held_bytes + len(payload) > HELD_BYTES:
            self._unflushed.pop()
            self.drop(lane.key)
        else:
            self._held_bytes += len(payload)

    def drop(self, key: str) -> None:
        """Count one that cannot be written."""
        self.drops[key] = self.drops.get(key, 0) + 1

    def _drop_waiting(self) -> int:
        """Count what is not written as dropped; how many."""
        rows, self._unflushed = self._unflushed, []
        return self._drop_all(rows)

    def _drop_all(self, rows: Sequence[_Row]) -> int:
        for lane, *_ in rows:
            self.drop(lane.key)
        return len(rows)

    def _look(self) -> None:
        """See whether there is room, and make some among the old sessions."""
        keep, limit = self._options.keep_free_bytes, self._options.root_bytes
        self.warning = ""
        if limit:
            removed, over = retention.make_room(self._root, limit, self.path)
            self.removed += removed
            if over:
                what = f"by {over / MB:.1f} MB that are marked, in use or not to be removed"
                self.warning = f"{self._root} has more than its quota, {what}"
        free = self.free_bytes
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
        if self._open(now_ns, keep + max(min(keep, MOST_MORE), LEAST_ROOM)):
            rest = self._write_held(keep + END_ROOM)
            try:
                if rest and self._segment is not None:
                    self._finish()
            except OSError as error:
                self._stumble(error)
            self._unflushed += rest
            if self._segment is None:
                self._pause(f"{len(self._unflushed)} messages that wait need more than is free")

    def _write_held(self, keep_bytes: int) -> list[_Row]:
        """Write what waited, as long as so much stays free; what the disk has no room for."""
        rows, self._unflushed = self._unflushed, []
        done = size = 0
        most = self.free_bytes - keep_bytes
        try:
            while done < len(rows) and self._segment is not None:
                lane, received_ns, payload, published_ns, sequence = rows[done]
                if size + len(payload) > most:
                    break
                done += 1
                self._write((self._lane(lane.key, lane.encoding), received_ns, payload, published_ns, sequence))
                size += len(payload)
                if size >= BATCH:
                    self._flush()
                    size, most = 0, self.free_bytes - keep_bytes
            self._flush()
        except OSError as error:
            if not session_dir.is_full(error):
                self._unflushed += rows[done:]  # whoever ends this counts them
            self._stumble(error)
        return rows[done:]

    # ------------------------------------------------------------------ the directory

    def _copy(self) -> None:
        for name, source in self._options.copied.items():
            try:
                shutil.copyfile(source, self.path / name)
            except OSError as error:  # no reason to record nothing
                self.uncopied.append(f"{source} could not be copied into {self.path}: {error.strerror or error}")
        if self.uncopied:
            self.description.error = "; ".join(self.uncopied)
            self.description.write(self.path)

    def _describe(self, now_ns: int | None, *, closed: bool) -> None:
        description = self.description
        if now_ns is not None:
            description.ended, description.closed = session_dir.iso(_wall(now_ns)), closed
        description.messages = self._written
        description.drops, description.missed = dict(self.drops), self.missed
        description.recovered = dict(self.recovered)
        description.write(self.path)


def _wall(now_ns: int) -> datetime:
    return datetime.fromtimestamp(now_ns / 1e9, UTC)
