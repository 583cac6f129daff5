"""A wait while the wall clock steps by an hour, or while the computer sleeps. Virtual time."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.client.condition import KeyCondition
from fleet.client.reading import MAX_STAMP_AHEAD_S, Reading
from fleet.client.wait import ConditionWait
from schemas.gen import fleet_v1_pb2 as pb

EPOCH = datetime(2026, 3, 14, 15, 0, 0, 0, UTC)
HOUR_S = 3600.0
FOR_S = 5.0


class SteppedWait:
    """A wait for a near car that reports once a second. Somebody may set the clock, or the computer may sleep."""

    def __init__(self, topic: str = "sensor/range", when: str = "range_m < 0.3", for_s: float = 0.0) -> None:
        self.now_s, self.wall_s = 100.0, 0.0
        self._key = f"fleet/red/{topic}"
        self._wait = ConditionWait(KeyCondition.of(when, self._key), for_s)

    @property
    def clock(self) -> datetime:
        return EPOCH + timedelta(seconds=self.wall_s)

    def hear(self, range_m: float = 0.2, *, passed_s: float = 1.0, step_s: float = 0.0) -> bool:
        self.now_s += passed_s
        self.wall_s += passed_s + step_s
        value = pb.Range(range_m=range_m) if "range" in self._key else pb.CommandEvent(verb="led")
        return self._wait.ends(Reading(self._key, self.clock, value), self.clock, self.now_s)

    def query(self, stamp_s: float) -> bool:
        """Take a stored reading, as from a query."""
        value = pb.Range(range_m=0.2)
        return self._wait.ends(Reading(self._key, EPOCH + timedelta(seconds=stamp_s), value), self.clock)


@pytest.mark.parametrize("step_s", [-HOUR_S, HOUR_S])
def test_wall_clock_step_ends_no_wait(step_s: float) -> None:
    wait = SteppedWait()
    assert not wait.hear(0.5)
    assert not wait.hear(0.5, step_s=step_s)
    assert wait.hear(0.2)


@pytest.mark.parametrize("step_s", [-HOUR_S, HOUR_S])
@pytest.mark.parametrize(("topic", "when"), [("sensor/range", "range_m < 0.3"), ("event/command", "verb == 'led'")])
def test_hold_duration_restarts_and_ignores_clock_steps(step_s: float, topic: str, when: str) -> None:
    wait = SteppedWait(topic, when, FOR_S)
    assert [wait.hear() for _ in range(4)] == [False] * 4
    assert not wait.hear(step_s=step_s)
    assert [wait.hear() for _ in range(5)] == [False] * 4 + [True]


@given(st.lists(st.tuples(st.booleans(), st.sampled_from([0.0, 0.0, 0.0, HOUR_S, -HOUR_S, 0.4, -0.4])), max_size=60))
def test_wait_ends_only_after_its_time_and_always_then(seen: list[tuple[bool, float]]) -> None:
    wait, held_s = SteppedWait(for_s=FOR_S), float("-inf")
    for near, step_s in seen:
        ended = wait.hear(0.2 if near else 0.9, step_s=step_s)
        is_step = abs(step_s) > 1
        held_s = float("-inf") if not near else 0.0 if is_step or held_s < 0 else held_s + 1.0
        if held_s < FOR_S - 1.0:  # small steps count as time
            assert not ended or held_s + 0.4 * len(seen) >= FOR_S
    for _ in range(8):
        ended = wait.hear(0.2)
    assert ended


@pytest.mark.parametrize(
    ("stamp_s", "ends"),
    [
        (-1.0, True),
        (-HOUR_S, False),
        (MAX_STAMP_AHEAD_S - 1.0, True),
        (MAX_STAMP_AHEAD_S + 1.0, False),
        (HOUR_S, False),
    ],
)
def test_stored_reading_from_before_clock_step_is_not_fresh(stamp_s: float, *, ends: bool) -> None:
    assert SteppedWait().query(stamp_s) is ends


def test_published_readings_count_after_stored_one_from_future() -> None:
    wait = SteppedWait(for_s=2.0)
    assert not wait.query(HOUR_S)
    assert [wait.hear() for _ in range(3)] == [False, False, True]


def test_sender_whose_clock_is_ahead_is_heard() -> None:
    wait = SteppedWait()
    value = Reading("fleet/red/sensor/range", wait.clock + timedelta(seconds=HOUR_S), pb.Range(range_m=0.2))
    assert wait._wait.ends(value, wait.clock, wait.now_s)


def test_replay_is_old_and_published_now() -> None:
    wait = SteppedWait(for_s=2.0)
    assert not any(wait.query(-HOUR_S + at) for at in range(4)), "an answer may have waited for an hour"
    wait.wall_s = -7 * HOUR_S
    value = pb.Range(range_m=0.2)
    ended = []
    for _ in range(4):
        wait.now_s += 1.0
        wait.wall_s += 1.0
        ended.append(wait._wait.ends(Reading(wait._key, wait.clock, value), EPOCH, wait.now_s))
    assert ended == [False, False, True, True]
