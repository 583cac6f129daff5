"""How far a gateway's clock is off, by its states. tests/e2e/test_wrong_clock.py has one whose clock is minutes off."""

import pytest

from fleet.client.gateway_clock import GatewayClock, describe_clock

S = 10**9


def clock_of(off_s: float, delays_s: list[float], boot_id: str = "a") -> GatewayClock:
    clock = GatewayClock()
    for second, delay_s in enumerate(delays_s):
        sent_ns = (1_000 + second) * S
        clock.take(boot_id, sent_ns + round(off_s * S), sent_ns + round(delay_s * S))
    return clock


@pytest.mark.parametrize("off_s", [-86_400.0, -240.0, 0.0, 7.0, 240.0])
def test_message_with_the_shortest_way_tells(off_s: float) -> None:
    found = clock_of(off_s, [9.0, 8.0, 0.01, 20.0]).off_s
    assert found == pytest.approx(off_s, abs=0.02)


def test_one_message_tells_nothing_nor_does_the_same_again() -> None:
    assert GatewayClock().off_s is None
    assert clock_of(240.0, [0.0]).off_s is None
    clock = clock_of(240.0, [0.0])
    clock.take("a", 1_240 * S, 1_000 * S)  # a second state of the same moment
    assert clock.off_s is None


def test_clock_offset_starts_anew_with_new_gateway_process() -> None:
    clock = clock_of(240.0, [0.0, 0.0])
    clock.take("b", 2_000 * S, 2_000 * S)
    assert clock.off_s is None
    clock.take("b", 2_001 * S, 2_001 * S)
    assert clock.off_s == 0.0


def test_words_name_how_far_and_which_side() -> None:
    assert describe_clock("red", None) == describe_clock("red", 4.9) == describe_clock("red", -5.0) == ""
    assert "4 min 10 s behind" in describe_clock("red", -250.0)
    assert "2 h 6 s ahead" in describe_clock("red", 7206.2)
