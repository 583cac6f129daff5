"""What the quota takes first: tables of cases, and what holds of any sessions."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.recording.writing.quota_choice import PINNED_SHARE, Spans, StoredSegment, StoredSession, choose


def stored(name: str, *segments: tuple[int, int, bool], tables: int = 0, other: int = 0) -> StoredSession:
    """Return a session of segments: begin, size, pinned."""
    made = (
        StoredSegment(name, f"{number:04d}.mcap", size, begin, begin + 1, 1, pinned)
        for number, (begin, size, pinned) in enumerate(segments, 1)
    )
    return StoredSession(name, tuple(made), tables, other)


A = stored("a", (0, 10, False), (1, 10, True), (2, 10, False))
B = stored("b", (3, 10, False), (4, 10, True), tables=5, other=1)


@pytest.mark.parametrize(
    ("over", "quota", "taken", "removed"),
    [
        (0, 100, "", ""),
        (1, 100, "a1", ""),
        (20, 100, "a1 a3", ""),
        (21, 100, "a1 a3 b1", ""),
        (35, 100, "a1 a3 b1", ""),
        (99, 100, "a1 a3 b1", ""),
        (1, 39, "a2", ""),
        (11, 39, "a2 a1", ""),
    ],
)
def test_unpinned_segments_go_first_and_pins_have_half(over: int, quota: int, taken: str, removed: str) -> None:
    found = choose([A, B], over, quota)
    assert " ".join(f"{each.session}{int(each.file[:4])}" for each in found.segments) == taken
    assert " ".join(found.removed) == removed


def test_tables_go_before_pins_and_an_empty_session_before_all() -> None:
    pinned = stored("b", (4, 10, True), tables=5)
    assert choose([pinned], 5, 100).tables == ["b"]
    assert choose([pinned], 5, 100).segments == []
    assert choose([A, stored("c", other=9)], 9, 100).removed == ["c"]


SESSIONS = st.lists(
    st.lists(st.tuples(st.integers(0, 50), st.integers(1, 20), st.booleans()), max_size=6), max_size=5
).map(lambda found: [stored(str(number), *each) for number, each in enumerate(found)])


@given(sessions=SESSIONS, over=st.integers(0, 200), quota=st.integers(1, 200))
def test_no_pin_goes_while_pins_have_no_more_than_half(sessions: list[StoredSession], over: int, quota: int) -> None:
    found = choose(sessions, over, quota)
    every = [each for session in sessions for each in session.segments]
    assert found.freed >= over or all(each.pinned for each in every if each not in found.segments)
    assert len({(each.session, each.file) for each in found.segments}) == len(found.segments)
    left = [each for each in every if each not in found.segments]
    pinned_before = sum(each.bytes for each in every if each.pinned)
    pinned_left = sum(each.bytes for each in left if each.pinned)
    largest = max((each.bytes for each in found.segments if each.pinned), default=0)
    assert pinned_left == pinned_before or pinned_left + largest > int(quota * PINNED_SHARE), "pins keep their half"
    for pinned in (True, False):
        ages = [each.begin_ns for each in found.segments if each.pinned is pinned]
        kept = [each.begin_ns for each in left if each.pinned is pinned]
        assert not ages or not kept or max(ages) <= min(kept), "the oldest go first"


@given(
    spans=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 9)).map(lambda each: (each[0], sum(each))), max_size=8),
    begin=st.integers(0, 40),
    length=st.integers(0, 9),
)
def test_spans_touch_as_each_of_them_does(spans: list[tuple[int, int]], begin: int, length: int) -> None:
    expected = any(one <= begin + length and other >= begin for one, other in spans)
    assert Spans(spans).touch(begin, begin + length) is expected
