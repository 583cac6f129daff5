"""The one exponential backoff."""

from schemas.backoff import backoff_s


def test_delay_doubles_up_to_its_limit_and_never_overflows() -> None:
    assert [backoff_s(failures, 0.25, 10.0) for failures in (1, 2, 3, 7)] == [0.25, 0.5, 1.0, 10.0]
    # A mode command that fails for nine hours is tried a thousand times: 2.0 ** 1024 would raise OverflowError.
    assert backoff_s(5000, 1.0, 30.0) == 30.0
