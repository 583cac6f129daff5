"""Tests of the rate limit."""

from schemas.token_bucket import TokenBucket


def test_so_much_at_once_and_so_much_a_second() -> None:
    allowance = TokenBucket(per_s=100, at_once=500)
    assert allowance.take(300, 7.0) == 300
    assert allowance.take(300, 7.0) == 200
    assert allowance.take(300, 7.0) == 0
    assert allowance.take(300, 8.0) == 100
    assert allowance.take(300, 8.5) == 50
    assert allowance.take(1000, 1000.0) == 500


def test_little_by_little_nothing_is_lost() -> None:
    allowance = TokenBucket(per_s=100, at_once=10)
    assert sum(allowance.take(1, number / 100) for number in range(1000)) == 1000


def test_clock_that_goes_back_gives_nothing() -> None:
    allowance = TokenBucket(per_s=100, at_once=100)
    assert allowance.take(100, 5.0) == 100
    assert allowance.take(100, 4.0) == 0
    assert allowance.take(100, 5.5) == 50
