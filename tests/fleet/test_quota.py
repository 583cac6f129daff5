"""What a recorder keeps, as a value."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.commands import record
from fleet.quota import MAX_SEGMENTS, QUOTA_SEGMENT_S, Quota, format_size, parse_size

MB = 10**6
SIZES = st.one_of(st.just(0), st.integers(MB, 10**15))


@pytest.mark.parametrize(
    ("text", "size"),
    [("20GB", 20 * 10**9), ("1 mb", MB), ("1.5GB", 1_500 * MB), ("7", 7), ("7B", 7), ("1e6", None), ("GB", None)],
)
def test_size_is_read(text: str, size: int | None) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize(
    ("size", "text"), [(20 * 10**9, "20GB"), (1_500 * MB, "1500MB"), (10**15, "1000TB"), (1_000_001, "1000001B")]
)
def test_size_is_written_with_its_largest_whole_unit(size: int, text: str) -> None:
    assert format_size(size) == text


@given(total=SIZES, session=SIZES)
def test_recorder_gets_each_limit_as_it_was(total: int, session: int) -> None:
    options = record.run.make_context("run", list(Quota(total, session).arguments)).params
    assert (options["quota"] or 0, options["session_size"] or 0) == (total, session)


@pytest.mark.parametrize(
    ("quota", "size", "segments", "over"),
    [
        (Quota(), 10**15, 1, False),
        (Quota(), 0, MAX_SEGMENTS, True),
        (Quota(20 * MB), 2 * MB - 1, 1, False),
        (Quota(20 * MB), 2 * MB, 1, True),
        (Quota(20 * MB, 5 * MB), 4 * MB, 1, False),
        (Quota(session=5 * MB), 5 * MB, 1, True),
    ],
)
def test_when_a_session_has_enough(quota: Quota, size: int, segments: int, over: bool) -> None:
    assert quota.is_session_over(size, segments) is over


def test_quota_excess_and_segment_length() -> None:
    assert (Quota(10).excess(9), Quota(10).excess(12), Quota().excess(12)) == (0, 2, 0)
    assert (Quota(10).segment_s(600.0), Quota(session=10).segment_s(600.0)) == (QUOTA_SEGMENT_S, 600.0)
