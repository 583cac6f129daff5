"""Times as people read them, in zones that the tests set."""

import pytest

from fleet.recording import time_spec
from schemas import local_time
from tests.support.zones import zone

AT_NS = 1_773_501_377_123_456_789
"""2026-03-14T15:16:17 UTC."""


@pytest.mark.parametrize(
    ("where", "date", "offset"),
    [
        ("UTC0", "2026-03-14 15:16:17.123 UTC", "2026-03-14T15:16:17.123+00:00"),
        ("CET-1", "2026-03-14 16:16:17.123 CET", "2026-03-14T16:16:17.123+01:00"),
        ("NST3:30", "2026-03-14 11:46:17.123 NST", "2026-03-14T11:46:17.123-03:30"),
    ],
)
def test_exact_time_is_local_and_can_be_typed_again(where: str, date: str, offset: str) -> None:
    with zone(where):
        assert local_time.exact(AT_NS) == date
        assert local_time.with_offset(AT_NS) == offset
        assert time_spec.at_ns(local_time.with_offset(AT_NS), 0, 0, 0.0) == AT_NS // 1_000_000 * 1_000_000


@pytest.mark.parametrize("text", ["", "yesterday", "2026-03-14T15:16:17"])
def test_stored_text_without_a_zone_is_not_converted(text: str) -> None:
    assert local_time.of_iso(text) == text


def test_stored_time_is_told_in_the_local_zone() -> None:
    with zone("CET-1"):
        assert local_time.of_iso("2026-03-14T15:16:17.123Z") == "2026-03-14 16:16:17 CET"


@pytest.mark.parametrize("at_ns", [-1, 10**21])
def test_time_beyond_calendar_is_shown_as_number(at_ns: int) -> None:
    assert local_time.exact(at_ns) == local_time.with_offset(at_ns) == f"{at_ns} ns"
