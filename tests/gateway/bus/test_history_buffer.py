"""Tests of the history buffers, and of the time ranges in queries. Any text is a range or raises BadRange."""

import contextlib
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.bus.history_buffer import BadRange, Bound, HistoryBuffer, Value, parse_range
from schemas.topics import HISTORY

S = 1_000_000_000
AT = 5_000.0
"""The monotonic clock at `NOW`."""
NOW = 1_800_000_000 * S
EARLY = Bound(0)
FOREVER = Bound((1 << 63) + 1)


def age(ns: int) -> Bound:
    return Bound(ns, from_now=True)


@pytest.mark.parametrize(
    ("text", "begin", "end"),
    [
        ("[now(-30s)..]", age(-30 * S), FOREVER),
        ("[now(-30s)..[", age(-30 * S), Bound(1 << 63)),
        ("[..now()]", EARLY, age(1)),
        ("[..]", EARLY, FOREVER),
        ("[now(-1m)..now(-30s)]", age(-60 * S), age(-30 * S + 1)),
        ("]now(-1m)..now(-30s)[", age(-60 * S + 1), age(-30 * S)),
        ("[now(-2h)..now(1h)]", age(-7200 * S), age(3600 * S + 1)),
        ("[now(-1.5)..]", age(-S * 3 // 2), FOREVER),
        ("[now(-250ms)..now(-10us)]", age(-S // 4), age(-10_000 + 1)),
        ("[now(-3u)..now()]", age(-3000), age(1)),
        ("[now(-1d)..now(-1w)]", age(-86_400 * S), age(-604_800 * S + 1)),
        ("[2026-11-21T04:00:00Z..]", Bound(1_795_233_600 * S), FOREVER),
        ("[2026-11-21T04:00:00.000001+00:00..]", Bound(1_795_233_600 * S + 1000), FOREVER),
        ("[2026-11-21T05:00:00+01:00..2026-11-21T04:00:01]", Bound(1_795_233_600 * S), Bound(1_795_233_601 * S + 1)),
        ("[2026-11-21T04:00:00Z..now()]", Bound(1_795_233_600 * S), age(1)),
        ("[1969-12-31T23:59:59.500000Z..]", Bound(-S // 2), FOREVER),
        (" [now()..] ", age(0), FOREVER),
    ],
)
def test_parse_range_is_half_open_in_nanoseconds(text: str, begin: Bound, end: Bound) -> None:
    assert parse_range(text) == (begin, end)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "now(-30s)",
        "[now(-30s)]",
        "[now(-30s..]",
        "[now(-30x)..]",
        "[now(nan)..]",
        "[now(inf)..]",
        "[now(-1e3s)..]",
        f"[now({'9' * 400}s)..]",
        f"[now({'9' * 5000}s)..]",
        "[yesterday..]",
        "[2026-13-01T00:00:00Z..]",
        "[2026-11-21T04:00:00Z",  # Zenoh cuts parameters at `;`, so `[start;duration]` arrives like this
        "[2026-11-21T04:00:00Z;10s]",
        "(now()..)",
    ],
)
def test_invalid_history_range_is_refused_with_syntax(text: str) -> None:
    with pytest.raises(BadRange, match=r"cannot be read: write \[now\(-30s\)\.\.\]"):
        parse_range(text)


def filled(count: int, size: int = 5, *, clock_set_s: int = 0) -> HistoryBuffer:
    """One value a second. clock_set_s: the wall clock was that much ahead when they were stamped."""
    ring = HistoryBuffer(size)
    for number in range(count):
        age_s = count - number
        ring.add(Value(AT - age_s, NOW + (clock_set_s - age_s) * S, str(number).encode()))
    return ring


@pytest.mark.parametrize(
    ("time_range", "last", "found"),
    [
        (None, None, "7"),
        (None, "1", "7"),
        (None, "3", "567"),
        (None, "03", "567"),
        (None, "99999999999", "34567"),
        ("[now(-2s)..]", None, "67"),
        ("]now(-2s)..]", None, "7"),
        ("[now(-4s)..now(-2s)]", None, "456"),
        ("[now(-4s)..now(-2s)[", None, "45"),
        ("[now(-4s)..]", "2", "67"),
        ("[now(-1h)..]", None, "34567"),
        ("[now()..]", None, ""),
    ],
)
def test_history_ring_returns_latest_last_or_range(time_range: str | None, last: str | None, found: str) -> None:
    values = filled(8).select(time_range=time_range, last=last, now=AT)
    assert b"".join(value.payload for value in values).decode() == found


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_clock_step_does_not_age_history(step_s: int) -> None:
    values = filled(8, clock_set_s=step_s).select(time_range="[now(-2s)..]", last=None, now=AT)
    assert [value.payload for value in values] == [b"6", b"7"]


@pytest.mark.parametrize("step_s", [-3600, 0, 3600])
def test_date_selects_by_published_stamp(step_s: int) -> None:
    ring = filled(8, clock_set_s=step_s)
    (third, _, _) = ring.select(time_range=None, last="3", now=AT)
    shown = datetime.fromtimestamp(third.stamp_ns / S, UTC).isoformat()
    for now in (AT, AT + 0.000_001, AT + 100.0):
        values = ring.select(time_range=f"[{shown}..]", last=None, now=now)
        assert [value.payload for value in values] == [b"5", b"6", b"7"]


def test_computer_sleep_ages_history() -> None:
    ring = filled(8)
    ring.age(3600.0)
    ring.add(Value(AT, NOW, b"8"))
    assert [each.payload for each in ring.select(time_range="[now(-60s)..]", last=None, now=AT)] == [b"8"]
    assert len(ring.select(time_range=None, last="99", now=AT)) == 5


@pytest.mark.parametrize("last", ["", "0", "-1", "1.5", "three", "³", "٣", "1_0", " 3", "inf", "0" * 5000])
def test_invalid_last_count_is_refused(last: str) -> None:
    with pytest.raises(BadRange, match=f"whole number from 1 on. The history has at most {HISTORY} values"):
        filled(3).select(time_range=None, last=last, now=AT)


def test_huge_last_count_returns_all() -> None:
    assert len(filled(3).select(time_range=None, last="9" * 5000, now=AT)) == 3


def test_empty_history_selects_nothing() -> None:
    for time_range, last in [(None, None), ("[..]", None), (None, "3")]:
        assert HistoryBuffer(3).select(time_range=time_range, last=last, now=AT) == []


PIECES = st.sampled_from(["[", "]", "..", "now(", ")", "-", "1", "9" * 30, "s", "ms", "w", "Z", "T", ":", ";", "2026"])


@given(st.one_of(st.text(), st.lists(PIECES, max_size=12).map("".join)), st.one_of(st.none(), st.text()))
def test_any_text_is_a_selection_or_a_bad_range(time_range: str, last: str | None) -> None:
    with contextlib.suppress(BadRange):
        filled(3).select(time_range=time_range, last=last, now=AT)
