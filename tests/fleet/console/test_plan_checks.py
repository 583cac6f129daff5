"""Plans are checked in a process of their own, a few at a time for each person."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

import psutil
import pytest

from fleet.console import plan_checks
from fleet.console.budgets import MAX_OPEN_CHECKS
from fleet.console.plan_checks import PlanChecks, TooManyChecks
from fleet.policy.plan.parser import BadPlan, parse
from tests.support.page_flood import PLAN
from tests.support.processes import wait_for

GOOD = "roles:\n  guide: {mode: tracking}\n"
BAD = "roles:\n  guide: {mode: flying}\n"


@pytest.fixture
async def checks() -> AsyncIterator[PlanChecks]:
    made = PlanChecks()
    yield made
    await made.close()


def workers() -> list[psutil.Process]:
    """Return the processes that check plans, of this test. Others of the test's process may have ended unnoticed."""
    found = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # also of a zombie
            if "fleet.console.plan_checks" in child.cmdline():
                found.append(child)
    return found


async def test_a_plan_is_checked_as_the_parser_does(checks: PlanChecks) -> None:
    with pytest.raises(BadPlan) as found:
        parse(BAD)
    assert await checks.check(GOOD, "mia") == (True, "")
    assert await checks.check(BAD, "mia") == (False, str(found.value))
    assert await checks.check("a: \ud800 \n\x00", "mia") != (True, "")
    assert await checks.check(PLAN, "mia") == (True, "")
    assert len(workers()) == 1


async def test_a_person_has_few_open_checks_and_others_have_theirs(checks: PlanChecks) -> None:
    mine = [asyncio.ensure_future(checks.check(PLAN, "mia")) for _ in range(MAX_OPEN_CHECKS)]
    await asyncio.sleep(0)
    assert checks.is_busy("mia")
    with pytest.raises(TooManyChecks):
        await checks.check(GOOD, "mia")
    assert await checks.check(GOOD, "bob") == (True, "")
    assert await asyncio.gather(*mine) == [(True, "")] * MAX_OPEN_CHECKS
    assert not checks.is_busy("mia")


async def test_a_check_that_is_given_up_or_dies_spoils_no_other(checks: PlanChecks) -> None:
    assert await checks.check(GOOD, "mia") == (True, "")
    given_up = asyncio.ensure_future(checks.check(PLAN, "mia"))
    await asyncio.sleep(0)
    given_up.cancel()
    assert await checks.check(BAD, "mia") != (True, ""), "no answer of the plan before"
    await asyncio.to_thread(wait_for, lambda: len(workers()) == 1, "the one of the plan that was given up has ended")
    for worker in workers():
        worker.kill()
    assert await checks.check(GOOD, "mia") == (True, "")


async def test_the_process_ends_when_nothing_was_checked_for_a_while(
    checks: PlanChecks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_checks, "IDLE_CHECKER_S", 0.0)
    assert await checks.check(GOOD, "mia") == (True, "")
    await asyncio.to_thread(wait_for, lambda: not workers(), "it has ended")
    assert await checks.check(GOOD, "mia") == (True, "")
