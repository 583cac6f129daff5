"""Counts which losses of several recordings remain when they are merged. Pure.

A recorder counts the messages that it dropped, and those that never reached it. Another recorder of the same time may
have them. So each message of another session, within the time of a session that does not have it, makes up for one loss
of that session. Losses of sessions that overlap may be the same messages, so of those the greatest number counts.
"""

from collections.abc import Mapping, Sequence

from fleet.recording.session_dir import SessionInfo
from fleet.recording.time_spec import iso_ns

_FOREVER_NS = 2**63


class MergedLosses:
    """The losses of the sessions that are being merged, by key."""

    def __init__(self, sessions: Sequence[SessionInfo | None]) -> None:
        """`sessions` are the descriptions of the sessions. A session without one has counted no losses."""
        self._lossy: dict[int, tuple[SessionInfo, tuple[int, int]]] = {
            number: (info, _span_ns(info))
            for number, info in enumerate(sessions)
            if info is not None and (info.drops or info.missed)
        }
        self._own: dict[tuple[int, str], int] = {}
        """Number of messages of each key, by session."""
        self._merged: dict[tuple[int, str], int] = {}
        """Number of messages of each key in the merged session that are of the time of a session, by that session."""

    def on_read(self, number: int, key: str) -> None:
        """Count a message of a session."""
        if number in self._lossy:
            self._own[number, key] = self._own.get((number, key), 0) + 1

    def on_written(self, key: str, log_ns: int) -> None:
        """Count a message of the merged session."""
        for number, (_, (begin_ns, end_ns)) in self._lossy.items():
            if begin_ns <= log_ns <= end_ns:
                self._merged[number, key] = self._merged.get((number, key), 0) + 1

    def remaining(self) -> tuple[Mapping[str, int], Mapping[str, int]]:
        """Return how many messages are still missing by key: those dropped by a recorder, and those missed by it."""
        drops: dict[str, int] = {}
        missed: dict[str, int] = {}
        for group in self._overlapping():
            for key in {key for number in group for key in (*self._info(number).drops, *self._info(number).missed)}:
                left = [self._left(number, key) for number in group]
                worst = max(left, key=sum)
                drops[key] = drops.get(key, 0) + worst[0]
                missed[key] = missed.get(key, 0) + worst[1]
        return _without_zeros(drops), _without_zeros(missed)

    def _info(self, number: int) -> SessionInfo:
        return self._lossy[number][0]

    def _left(self, number: int, key: str) -> tuple[int, int]:
        """Return how many dropped and missed messages of a session no other session has."""
        info = self._info(number)
        made_up = max(0, self._merged.get((number, key), 0) - self._own.get((number, key), 0))
        dropped, missed = info.drops.get(key, 0), info.missed.get(key, 0)
        return max(0, dropped - made_up), max(0, missed - max(0, made_up - dropped))

    def _overlapping(self) -> list[list[int]]:
        """Return the sessions in groups. Sessions of different groups do not overlap in time."""
        groups: list[list[int]] = []
        until_ns = -1
        for number, (_, (begin_ns, end_ns)) in sorted(self._lossy.items(), key=lambda item: item[1][1]):
            if begin_ns > until_ns:
                groups.append([])
            groups[-1].append(number)
            until_ns = max(until_ns, end_ns)
        return groups


def _span_ns(info: SessionInfo) -> tuple[int, int]:
    """Return when a session began and ended, by its recorder's clock. A time that is not known does not limit it."""
    return _ns_or(info.started, 0), _ns_or(info.ended, _FOREVER_NS)


def _ns_or(text: str | None, other_ns: int) -> int:
    try:
        return iso_ns(text) if text else other_ns
    except (ValueError, OverflowError):
        return other_ns


def _without_zeros(counts: Mapping[str, int]) -> dict[str, int]:
    return {key: count for key, count in counts.items() if count}
