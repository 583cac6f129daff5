"""Tests of the delay between attempts to connect, and of the attempts that are logged."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.reconnect_delay import (
    FIRST_DELAY_S,
    MAX_LOGGED_CAUSES,
    MAX_RECONNECT_DELAY_S,
    PROVEN_S,
    Attempts,
    delay_s,
)


@pytest.mark.parametrize(("failures", "longest_s"), [(1, 0.25), (2, 0.5), (3, 1.0), (4, 1.0), (10**9, 1.0)])
def test_backoff_doubles_to_a_second_with_jitter(failures: int, longest_s: float) -> None:
    assert delay_s(failures, 0.0) == longest_s / 2
    assert delay_s(failures, 1.0) == longest_s


@given(st.integers(1, 10_000), st.floats(0, 1))
def test_reconnect_delay_bounds(failures: int, jitter: float) -> None:
    assert FIRST_DELAY_S / 2 <= delay_s(failures, jitter) <= MAX_RECONNECT_DELAY_S


def test_flapping_link_waits_longer_and_is_told_once() -> None:
    attempts = Attempts()
    told, waits = [], []
    for cycle in range(6):
        told.append((attempts.on_open(cycle), attempts.check_proven(cycle + 0.9 * PROVEN_S, has_reading=False)))
        told.append((attempts.on_failed("reset" if cycle % 2 else "closed"), False))
        waits.append(attempts.delay_s(1.0))
    assert told == [(True, False)] * 2 + [(False, False), (True, False)] + [(False, False)] * 8
    assert waits == [0.25, 0.5, 1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(("after_s", "heard"), [(0.0, True), (PROVEN_S, False)])
def test_useful_link_is_retried_at_once(after_s: float, heard: bool) -> None:
    attempts = Attempts()
    for _ in range(5):
        attempts.on_open(0.0)
        attempts.on_failed("closed")
    assert not attempts.on_open(10.0)
    assert attempts.check_proven(10.0 + after_s, has_reading=heard), "its opening had not been told"
    assert not attempts.check_proven(10.0 + after_s, has_reading=heard), "once"
    assert attempts.on_failed("closed")
    assert attempts.delay_s(1.0) == FIRST_DELAY_S
    assert attempts.on_open(20.0)
    assert not attempts.check_proven(20.0 + after_s, has_reading=heard), "its opening had been told"


def test_ever_changing_causes_are_not_told_for_ever() -> None:
    attempts = Attempts()
    assert sum(attempts.on_failed(f"error {number}") for number in range(100)) == MAX_LOGGED_CAUSES
