"""Compares the recorded decisions about each car and role with those that are made now. Pure."""

from collections.abc import Iterator

from msgspec import Struct

from fleet.replay.analysis.recorded_decisions import RecordedDecision, Timeline


class DecisionDifference(Struct, frozen=True):
    """Time span in which the recorded decision, `then`, differs from the new one, `now`. None means no decision."""

    subject: str
    from_ns: int
    to_ns: int
    then: RecordedDecision | None
    now: RecordedDecision | None


def differences(then: Timeline, now: Timeline, start_ns: int, end_ns: int) -> Iterator[DecisionDifference]:
    """Yield every time span in which the two timelines differ. A decision holds until the next one."""
    for subject in sorted({*then, *now}):
        old, new = then.get(subject, []), now.get(subject, [])
        times = sorted({start_ns, *(decision.at_ns for decision in (*old, *new) if start_ns < decision.at_ns < end_ns)})
        open_from: int | None = None
        pair: tuple[RecordedDecision | None, RecordedDecision | None] = (None, None)
        for at_ns in (*times, end_ns):
            current = _at(old, at_ns), _at(new, at_ns)
            ends = at_ns == end_ns or _what(current[0]) == _what(current[1])
            if open_from is not None and (
                ends or (_what(current[0]), _what(current[1])) != (_what(pair[0]), _what(pair[1]))
            ):
                yield DecisionDifference(subject, open_from, at_ns, *pair)
                open_from = None
            if not ends and open_from is None:
                open_from, pair = at_ns, current


def _at(decisions: list[RecordedDecision], at_ns: int) -> RecordedDecision | None:
    found = None
    for each in decisions:
        if each.at_ns > at_ns:
            break
        found = each
    return found


def _what(decision: RecordedDecision | None) -> tuple[str, str, str] | None:
    return None if decision is None else decision.what
