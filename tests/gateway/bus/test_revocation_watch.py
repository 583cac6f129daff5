"""When a gateway looks whether the hub passes anything on, and when it takes its certificate for revoked."""

import pytest

from gateway.bus.revocation_watch import LOOKS, LinkChecks

FIRST, SECOND, NONE = "1a", "2b", ""
SILENT, PASSES, UNKNOWN = False, True, None


def taken(checks: LinkChecks, *looks: tuple[bool | None, str, str]) -> list[bool]:
    return [checks.take(before, after, found=found) for found, before, after in looks]


def test_silent_hub_means_revoked_once_after_three_looks() -> None:
    checks = LinkChecks()
    assert taken(checks, *[(SILENT, FIRST, FIRST)] * LOOKS) == [False] * (LOOKS - 1) + [True]
    assert not checks.is_due(FIRST)
    assert checks.is_due(SECOND), "new rules come with a new link"
    assert taken(checks, *[(SILENT, SECOND, SECOND)] * LOOKS)[-1]


def test_hub_that_passes_on_is_not_asked_again() -> None:
    checks = LinkChecks()
    assert checks.is_due(FIRST)
    assert taken(checks, (PASSES, FIRST, FIRST)) == [False]
    assert not checks.is_due(FIRST)
    assert not checks.is_due(NONE), "without a link there is nothing to ask"
    assert checks.is_due(SECOND)


@pytest.mark.parametrize(
    "between",
    [
        pytest.param((UNKNOWN, FIRST, FIRST), id="a session has lost its link"),
        pytest.param((SILENT, FIRST, SECOND), id="the link is replaced during a look"),
        pytest.param((SILENT, FIRST, NONE), id="the link is lost during a look"),
        pytest.param((SILENT, SECOND, SECOND), id="the link is replaced between two looks"),
    ],
)
def test_looks_that_prove_nothing_begin_the_count_again(
    between: tuple[bool | None, str, str],
) -> None:
    checks = LinkChecks()
    before = [(SILENT, FIRST, FIRST)] * (LOOKS - 1)
    assert not any(taken(checks, *before, between, *before))
    assert checks.is_due(FIRST)
    assert taken(checks, (SILENT, FIRST, FIRST)) == [True]
