"""Decides what the quota takes when the sessions are too large together. Pure; quota_removal.py removes it.

The unit is a segment: a file, with a quota of one minute. A segment is pinned if a pin of any session of its fleet
touches its time, because the time before a pin may be in another session.

Unpinned segments go first, the oldest of all sessions. Pinned ones may have half of the quota: if they have more, the
oldest of them go before anything else. So a condition that is always true leaves room for what comes. Tables for
questions go with the first segment of their session, as they are of no use then. If no other segment is left, all
tables go, which can be made again. What is pinned stays within its half, even where marked sessions, which stay whole,
leave less than that: all together are more than the quota then, and the recorder says so.
"""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

PINNED_SHARE: Final = 0.5
"""Maximum share of the quota that pinned segments have: the other half is for what comes."""


class Spans:
    """Times of pins, as one search."""

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
        """Return True if one of them has a moment in common with this time."""
        index = bisect_right(self._begins, end_ns) - 1
        return index >= 0 and self._ends[index] >= begin_ns


@dataclass(frozen=True, slots=True)
class StoredSegment:
    """One segment on the disk. Times: of its first and last message, ns since the epoch."""

    session: str
    file: str
    bytes: int
    begin_ns: int
    end_ns: int
    messages: int | None
    """None if nobody has counted them."""
    pinned: bool = False


@dataclass(frozen=True, slots=True)
class StoredSession:
    """A session that the quota may take from."""

    name: str
    segments: tuple[StoredSegment, ...]
    table_bytes: int = 0
    """Size of its tables for questions."""
    other_bytes: int = 0
    """Size of its other files. They go with its last segment."""


@dataclass(slots=True)
class Taking:
    """Segments, tables and whole sessions that go for the quota, in this order."""

    segments: list[StoredSegment] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    """Sessions that lose their tables."""
    removed: list[str] = field(default_factory=list)
    """Sessions that lose all."""
    freed: int = 0
    """Size of all of it, bytes."""


def choose(sessions: Sequence[StoredSession], over: int, quota: int) -> Taking:
    """Return what to take so that `over` bytes are free. It is less if that is not enough."""
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
        if not session.segments and taking.freed < over:  # its recorder was killed before the first
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
