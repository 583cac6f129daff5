"""How long to wait before the next try to connect."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.backoff import FIRST_S, LONGEST_S, delay_s


@pytest.mark.parametrize(("failures", "longest_s"), [(1, 0.25), (2, 0.5), (3, 1.0), (4, 1.0), (10**9, 1.0)])
def test_it_doubles_up_to_a_second_spread_over_the_upper_half(failures: int, longest_s: float) -> None:
    assert delay_s(failures, 0.0) == longest_s / 2
    assert delay_s(failures, 1.0) == longest_s


@given(st.integers(1, 10_000), st.floats(0, 1))
def test_it_is_never_nothing_and_never_long(failures: int, jitter: float) -> None:
    assert FIRST_S / 2 <= delay_s(failures, jitter) <= LONGEST_S
