"""Times within a session as people type them, in a zone that is not UTC."""

from collections.abc import Iterator

import pytest

from fleet.recording import time_spec
from tests.support.zones import zone

S = 1_000_000_000
NOON = 1_795_604_400
"""2026-11-25 12:00 CET."""
HOUR_S, DAY_S = 3600, 86_400


@pytest.fixture(autouse=True)
def in_cet() -> Iterator[None]:
    with zone("CET-1"):
        yield


@pytest.mark.parametrize(
    ("text", "begins", "length_s"),
    [
        ("12:05", NOON + 300, 60),
        ("12:05:10", NOON + 310, 1),
        ("0:30", NOON + 12.5 * HOUR_S, 60),
        ("90s", NOON + 90, 1),
        ("-5m", NOON + 13 * HOUR_S - 300, 1),
        ("2026-11-25 12:05", NOON + 300, 60),
        ("2026-11-25T11:05:00Z", NOON + 300, 1),
        ("today 13:00", NOON + HOUR_S, 60),
        ("yesterday 12:00", NOON - DAY_S, 60),
    ],
)
def test_a_time_is_local_and_within_the_session(text: str, begins: float, length_s: int) -> None:
    found = time_spec.span_ns(text, NOON * S, (NOON + 13 * HOUR_S) * S, NOON + HOUR_S)
    assert found == (begins * S, (begins + length_s) * S)


def test_a_time_of_day_on_two_days_names_both() -> None:
    with pytest.raises(ValueError, match=r"2026-11-25 14:05, 2026-11-26 14:05"):
        time_spec.at_ns("14:05", NOON * S, (NOON + 2 * DAY_S) * S, NOON)
    assert time_spec.is_within("14:05", NOON * S, (NOON + 2 * DAY_S) * S, NOON)


@pytest.mark.parametrize("text", ["11:58", "25:00", "12:60", "yesterday", "tomorrow 12:00", "noon", "12"])
def test_what_is_no_time_of_the_session_is_refused(text: str) -> None:
    try:
        begin_ns, _ = time_spec.span_ns(text, NOON * S, (NOON + 60) * S, NOON)
    except ValueError:
        return
    assert not NOON * S <= begin_ns <= (NOON + 11) * S
