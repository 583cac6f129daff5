"""Receive times follow the wall clock forward, and never go back."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.recording.writing.receive_clock import ReceiveClock

S = 1_000_000_000
HOUR = 3600 * S
BEGAN = 1_795_000_000 * S


class SetClock:
    """A wall clock that somebody sets, and a monotonic one."""

    def __init__(self) -> None:
        self.wall_ns, self.monotonic_ns = BEGAN, 100 * S
        self.clock = ReceiveClock(lambda: self.wall_ns, lambda: self.monotonic_ns)

    def wait(self, ns: int, *, step_ns: int = 0) -> int:
        """Let time pass, and the wall clock step. Return the receive time."""
        self.monotonic_ns += ns
        self.wall_ns += ns + step_ns
        return self.clock.ns()


@pytest.mark.parametrize(
    ("step_ns", "found"),
    [
        (0, 11 * S),
        (HOUR, HOUR + 11 * S),  # also a sleep of the computer
        (-HOUR, 11 * S),
        (-S // 10, 11 * S - S // 10),
    ],
)
def test_step_of_the_wall_clock(step_ns: int, found: int) -> None:
    clocks = SetClock()
    assert clocks.wait(10 * S) == BEGAN + 10 * S
    assert clocks.wait(S, step_ns=step_ns) == BEGAN + found
    assert clocks.wait(S) == BEGAN + found + S


@given(st.lists(st.tuples(st.integers(0, 10 * S), st.sampled_from([0, 0, 0, HOUR, -HOUR, 5, -5, S // 2, -S // 2]))))
def test_receive_times_never_go_back_and_time_that_passes_counts(steps: list[tuple[int, int]]) -> None:
    clocks, before, passed = SetClock(), BEGAN, 0
    for ns, step_ns in steps:
        now = clocks.wait(ns, step_ns=step_ns)
        assert now >= before
        passed, before = passed + ns, now
    assert before >= BEGAN + passed - S * (1 + len(steps))
