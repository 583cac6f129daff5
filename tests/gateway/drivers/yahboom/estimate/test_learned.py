"""The rhythm of a car, from the intervals of its reports."""

from gateway.drivers.yahboom.estimate.learned import MAX_LEARNED_S, Learned


def test_gap_is_no_rhythm() -> None:
    learned = Learned()
    assert not learned.add_interval(MAX_LEARNED_S + 0.1, echo=True)
    assert not learned.echo.is_known
    learned.add_interval(1.25, echo=True)
    assert not any(learned.add_interval(30.0, echo=True) for _ in range(5))
    assert learned.echo.median_s == 1.25
