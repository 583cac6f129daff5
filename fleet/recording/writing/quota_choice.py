"""Decides what the quota removes when the sessions together are too large. Pure; quota_removal.py removes the files.

The unit is a segment, which is one file: with a quota, one minute. A segment is pinned if a pin of any session of its
fleet touches its time, because the time before a pin may be in another session.

Pinned segments may fill half of the quota. If they fill more, the oldest of them are removed first, until they fill
half. So even if a condition is always true, there is room for new recordings. Then unpinned segments are removed, the
oldest first, whatever their sessions. The tables of a session (for SQL questions) are removed with its first segment,
because they no longer fit. If only pinned segments are left, all tables are removed, because they can be made again.
Pinned segments may fill their half even if marked sessions, which are never removed, fill the rest: then everything
together exceeds the quota, and the recorder warns.
"""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from typing import Final

from msgspec import Struct, field

PINNED_SHARE: Final = 0.5
"""Maximum share of the quota for pinned segments. The other half is for new recordings."""


class Spans:
    """Merged times of pins, for a fast search."""

    def __init__(self, spans: Iterable[tuple[int, int]]) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []
        for begin_ns, end_ns in sorted(spans):
            if self._ends and begin_ns <= self._ends[-1]:
                self._ends[-1] = max(self._ends[-1], end_ns)
            else:
                self._begins.append(begin_ns)
                self._ends.append(end_ns)

    def touch(self, begin_ns: int, end_ns: int) -> bool:
        """Return True if one of them overlaps this span of time."""
        index = bisect_right(self._begins, end_ns) - 1
        return index >= 0 and self._ends[index] >= begin_ns


class StoredSegment(Struct, frozen=True):
    """One segment on the disk. Times: of its first and last message, ns since the epoch."""

    session: str
    file: str
    bytes: int
    begin_ns: int
    end_ns: int
    messages: int | None
    """None if nobody has counted them."""
    pinned: bool = False


class StoredSession(Struct, frozen=True):
    """A session from which the quota may remove files."""

    name: str
    segments: tuple[StoredSegment, ...]
    table_bytes: int = 0
    """Size of its tables for SQL questions."""
    other_bytes: int = 0
    """Size of its other files. They are removed with its last segment."""


class Taking(Struct):
    """Segments, tables and whole sessions that the quota removes."""

    segments: list[StoredSegment] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    """Sessions that lose their tables."""
    removed: list[str] = field(default_factory=list)
    """Sessions that are removed as a whole."""
    freed: int = 0
    """Size, in bytes, of everything that is removed."""


def choose(sessions: Sequence[StoredSession], over: int, quota: int) -> Taking:
    """Return what to remove so that `over` bytes are freed, or less if there is not enough to remove."""
    taking = Taking()
    stored = {session.name: session for session in sessions}
    left = {session.name: len(session.segments) for session in sessions}
    segments = sorted((each for session in sessions for each in session.segments), key=_age)
    pinned = [each for each in segments if each.pinned]
    too_many = sum(each.bytes for each in pinned) - int(quota * PINNED_SHARE)

    def free_tables(name: str) -> None:
        if stored[name].table_bytes and name not in taking.tables:
            taking.tables.append(name)
            taking.freed += stored[name].table_bytes

    def take(segment: StoredSegment) -> None:
        taking.segments.append(segment)
        taking.freed += segment.bytes
        free_tables(segment.session)
        left[segment.session] -= 1
        if not left[segment.session]:
            taking.removed.append(segment.session)
            taking.freed += stored[segment.session].other_bytes

    for session in sessions:
        if not session.segments and taking.freed < over:  # its recorder was killed before the first segment
            taking.removed.append(session.name)
            taking.freed += session.table_bytes + session.other_bytes
    for segment in pinned:
        if taking.freed >= over or too_many <= 0:
            break
        take(segment)
        too_many -= segment.bytes
    for segment in segments:
        if taking.freed >= over:
            return taking
        if not segment.pinned:
            take(segment)
    for session in sessions:
        if taking.freed >= over:
            return taking
        free_tables(session.name)
    return taking


def _age(segment: StoredSegment) -> tuple[int, str, str]:
    return segment.begin_ns, segment.session, segment.file
