"""Counts which losses of several recordings remain when they are merged. Pure.

A recorder counts the messages that it dropped, and those that never reached it. Another recorder of the same time may
have them. So each message of another session, within the time of a session that does not have it, makes up for one loss
of that session. Losses of sessions that overlap may be the same messages, so the result is a number that was surely
lost, and more may be. If a session was cut in two, a backfill may have brought messages of the first part in the time
of the second one. And what a session lacks at its end, the one that continues it may have fetched. So what only such
sessions lack counts only if the numbers in the merged session have a gap.
"""

from collections.abc import Collection, Mapping, Sequence

from fleet.recording.reading.mcap_reader import Row
from fleet.recording.session_dir import SessionInfo
from fleet.recording.time_spec import iso_ns
from fleet.recording.tools.number_gaps import NumberGaps

_FOREVER_NS = 2**63


class MergedLosses:
    """The losses of the sessions that are being merged, by key."""

    def __init__(self, sessions: Sequence[SessionInfo | None], continued: Collection[int] = ()) -> None:
        """`sessions` are the descriptions of the sessions. A session without one has counted no losses.

        `continued`: the places in `sessions` of those that another one of them continues.
        """
        self._lossy: dict[int, tuple[SessionInfo, tuple[int, int]]] = {
            number: (info, _span_ns(info))
            for number, info in enumerate(sessions)
            if info is not None and (info.drops or info.missed)
        }
        late, never = set[str](), set[str]()
        for number, (info, _) in self._lossy.items():
            (late if number in continued else never).update(info.drops)
            (late if number in continued or _is_part(info) else never).update(info.missed)
        self._come_late = late - never
        """Keys of which all that is lacking may be in the next part, or in the session that continues this one."""
        self._numbers = NumberGaps()
        """The numbers of these keys in the merged session."""
        self._own: dict[tuple[int, str], int] = {}
        """Number of messages of each key, by session."""
        self._merged: dict[tuple[int, str], int] = {}
        """Number of messages of each key in the merged session that are of the time of a session, by that session."""

    def on_read(self, number: int, key: str) -> None:
        """Count a message of a session."""
        if number in self._lossy:
            self._own[number, key] = self._own.get((number, key), 0) + 1

    def on_written(self, row: Row) -> None:
        """Count a message of the merged session."""
        key, log_ns = row[0].channel.topic, row[2]
        if key in self._come_late:
            self._numbers.add(row)
        for number, (_, (begin_ns, end_ns)) in self._lossy.items():
            if begin_ns <= log_ns <= end_ns:
                self._merged[number, key] = self._merged.get((number, key), 0) + 1

    def remaining(self) -> tuple[Mapping[str, int], Mapping[str, int]]:
        """Return how many messages are surely missing by key: those dropped by a recorder, and those missed by it."""
        drops: dict[str, int] = {}
        missed: dict[str, int] = {}
        for key in {key for info, _ in self._lossy.values() for key in (*info.drops, *info.missed)}:
            drops[key], missed[key] = self._surely_lost(key)
        gaps = self._numbers.missing()
        for key in self._come_late:
            drops[key] = min(drops[key], gaps.get(key, 0))
            missed[key] = min(missed[key], gaps.get(key, 0) - drops[key])
        return _without_zeros(drops), _without_zeros(missed)

    def _surely_lost(self, key: str) -> tuple[int, int]:
        """Return the losses of those sessions that do not overlap with each other, and together lost the most."""
        found: list[tuple[int, tuple[int, int]]] = [(-1, (0, 0))]  # the greatest losses up to a time
        for number, (_, (begin_ns, end_ns)) in sorted(self._lossy.items(), key=lambda item: item[1][1][1]):
            before = next(losses for until_ns, losses in reversed(found) if until_ns < begin_ns)
            dropped, missed = self._left(number, key)
            found.append((end_ns, max(found[-1][1], (before[0] + dropped, before[1] + missed), key=sum)))
        return found[-1][1]

    def _left(self, number: int, key: str) -> tuple[int, int]:
        """Return how many dropped and missed messages of a session no other session has."""
        info, _ = self._lossy[number]
        made_up = max(0, self._merged.get((number, key), 0) - self._own.get((number, key), 0))
        dropped, missed = info.drops.get(key, 0), info.missed.get(key, 0)
        return max(0, dropped - made_up), max(0, missed - max(0, made_up - dropped))


def _is_part(info: SessionInfo) -> bool:
    return info.origin.get("by") == "cut"


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
