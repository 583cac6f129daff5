"""What two reports around a `MODE00` show, as a table."""

import pytest

from gateway.control.obedience import Obedience, Shown

CLOSED_AT = 10.0


@pytest.mark.parametrize(
    ("reports", "shown"),
    [
        ([9.5, 11.5], Shown.OBEYED),
        ([9.05, 11.05], Shown.OBEYED),
        ([9.5, 10.5, 11.5], Shown.LOST),
        ([9.98, 10.98, 11.98], None),  # where neither a lost nor a slow one would look otherwise
        ([9.1, 10.1, 11.1], Shown.LOST),
        ([9.4, 10.4, 12.4], Shown.OBEYED),  # a slow link: what had been sent before it came
        ([9.4, 10.4, 11.95], None),  # another block, of a servo, lies between
        ([9.1, 10.6, 11.1], None),  # the one before was held up on the way, the next one perhaps as well
        ([], None),
        ([11.5], None),
        ([10.5, 11.5], None),  # of what was before the first nothing is known
    ],
)
def test_with_an_echo(reports: list[float], shown: Shown | None) -> None:
    obedience = Obedience()
    said: list[Shown] = []
    closed = False
    for at in reports:
        if at > CLOSED_AT and not closed:
            obedience.closed(CLOSED_AT, awake=True)
            closed = True
        if (found := obedience.heard(at, echo=True)) is not None:
            said.append(found)
    assert said == ([] if shown is None else [shown])
    assert obedience.ever is (shown is Shown.OBEYED)


@pytest.mark.parametrize("without", range(3))
def test_a_ranging_without_echo_takes_a_second_and_shows_nothing(without: int) -> None:
    obedience = Obedience()
    assert obedience.heard(9.5, echo=without != 0) is None
    obedience.closed(CLOSED_AT, awake=True)
    assert obedience.heard(10.5, echo=without != 1) is None
    assert obedience.heard(11.5, echo=without != 2) is None


def test_what_it_was_told_behind_a_block_shows_nothing() -> None:
    obedience = Obedience()
    obedience.heard(9.5, echo=True)
    obedience.closed(CLOSED_AT, awake=False)
    assert [obedience.heard(at, echo=True) for at in (10.5, 11.5)] == [None, None]


@pytest.mark.parametrize(("gap_s", "shown"), [(0.1, Shown.LOST), (0.3, None)])
def test_a_loop_that_slept_has_perhaps_taken_reports_late(gap_s: float, shown: Shown | None) -> None:
    obedience = Obedience()
    obedience.heard(9.5, echo=True)
    obedience.closed(CLOSED_AT, awake=True)
    obedience.heard(10.5, echo=True)
    obedience.stalled(gap_s)
    assert obedience.heard(11.5, echo=True) is shown
    assert obedience.doubt_until == float("-inf")


def test_there_is_doubt_until_the_next_report_or_until_it_should_have_come() -> None:
    obedience = Obedience()
    obedience.heard(9.5, echo=True)
    obedience.closed(CLOSED_AT, awake=True)
    assert obedience.doubt_until == float("-inf")
    obedience.heard(10.5, echo=True)
    assert obedience.doubt_until == pytest.approx(11.9)
    obedience.heard(11.5, echo=True)
    assert obedience.doubt_until == float("-inf")
