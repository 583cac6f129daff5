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
        ("2026-11-25 06:05-05:00", NOON + 300, 60),
        ("2026-11-25 16:05:00+0500", NOON + 300, 1),
        ("today 13:00", NOON + HOUR_S, 60),
        ("yesterday 12:00", NOON - DAY_S, 60),
    ],
)
def test_time_is_local_and_within_the_session(text: str, begins: float, length_s: int) -> None:
    found = time_spec.span_ns(text, NOON * S, (NOON + 13 * HOUR_S) * S, NOON + HOUR_S)
    assert found == (begins * S, (begins + length_s) * S)


@pytest.mark.parametrize(
    ("text", "ago_s"),
    [
        ("30s", 30),
        ("-5m", 300),
        ("11:58", 120),
        ("12:30", DAY_S - 1800),
        ("12:00", DAY_S),
        ("yesterday 12:00", DAY_S),
        ("monday", 2.5 * DAY_S),
        ("wednesday 11:00", HOUR_S),
        ("thursday", 6.5 * DAY_S),
        ("2026-11-25 11:00", HOUR_S),
        ("2026-11-25T10:00:00Z", HOUR_S),
    ],
)
def test_time_in_the_past_is_the_last_one(text: str, ago_s: float) -> None:
    assert time_spec.ago_s(text, NOON) == ago_s


@pytest.mark.parametrize("text", ["noon", "today 12:30", "tomorrow 12:00", "2027-01-01", "25:00", "0001-01-01"])
def test_time_ago_in_future_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is in the future|is not a time"):
        time_spec.ago_s(text, NOON)


def test_wrong_time_names_formats_and_session_range() -> None:
    with pytest.raises(ValueError, match=r"from 2026-11-25 12:00:00 CET to 12:01:00 CET") as refused:
        time_spec.span_ns("noon", NOON * S, (NOON + 60) * S, NOON)
    assert time_spec.RULE in str(refused.value)


def test_repeated_hour_is_ambiguous_and_missing_hour_refused() -> None:
    with zone("CET-1CEST,M3.5.0,M10.5.0/3"):
        twice = 1_792_886_400  # 2026-10-25 00:00 UTC: 2:00 CEST. One hour later it is 2:00 CET.
        with pytest.raises(ValueError, match=r"2026-10-25T02:30:00\.000\+02:00, 2026-10-25T02:30:00\.000\+01:00"):
            time_spec.at_ns("2:30", twice * S, (twice + 2 * HOUR_S) * S, NOON)
        assert time_spec.at_ns("2:30", (twice + HOUR_S) * S, (twice + 2 * HOUR_S) * S, NOON) == (twice + 5400) * S
        missing = 1_774_742_400  # 2026-03-29 00:00 UTC: 1:00 CET. One hour later it is 3:00 CEST.
        with pytest.raises(ValueError, match="is not in the session"):
            time_spec.at_ns("2:30", missing * S, (missing + 2 * HOUR_S) * S, NOON)
        with pytest.raises(ValueError, match="was not in the last 24 hours"):
            time_spec.ago_s("2:30", missing + 2 * HOUR_S)


def test_time_of_day_on_two_days_names_both() -> None:
    with pytest.raises(ValueError, match=r"2026-11-25 14:05, 2026-11-26 14:05"):
        time_spec.at_ns("14:05", NOON * S, (NOON + 2 * DAY_S) * S, NOON)
    assert time_spec.is_within("14:05", NOON * S, (NOON + 2 * DAY_S) * S, NOON)


@pytest.mark.parametrize(
    ("text", "ran"),
    [
        ("2026-11-25", True),
        ("wednesday", True),
        ("today", True),
        ("2026-11-24", False),
        ("yesterday", False),
        ("2026-11-26", False),
        ("2026-11-25 00:00", False),
    ],
)
def test_session_ran_on_a_day(text: str, ran: bool) -> None:
    assert time_spec.is_within(text, NOON * S, (NOON + 60) * S, NOON) is ran


@pytest.mark.parametrize("text", ["11:58", "25:00", "12:60", "yesterday", "tomorrow 12:00", "noon", "12"])
def test_span_outside_session_is_refused(text: str) -> None:
    try:
        begin_ns, _ = time_spec.span_ns(text, NOON * S, (NOON + 60) * S, NOON)
    except ValueError:
        return
    assert not NOON * S <= begin_ns <= (NOON + 11) * S
