"""Plans are checked in a process of their own, a few at a time for each person."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from fleet.console.budgets import MAX_OPEN_CHECKS
from fleet.console.plan_answer import MAX_TOLD_CHARACTERS, PlanQuestion
from fleet.console.plan_checks import PlanChecks
from fleet.console.worker import TooManyQuestions
from fleet.policy.plan.plan_parser import BadPlan, parse
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.page_flood import PLAN
from tests.support.processes import wait_for

GOOD = "roles:\n  guide: {mode: tracking}\n"
BAD = "roles:\n  guide: {mode: flying}\n"


@pytest.fixture
async def checks(tmp_path: Path) -> AsyncIterator[PlanChecks]:
    made = PlanChecks(tmp_path / "fleet.yaml")
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


async def is_good(checks: PlanChecks, text: str, person: str = "mia") -> bool:
    return bool((await checks.check(PlanQuestion(text), person))["ok"])


def here(*cars: str) -> tuple[tuple[float, Sample], ...]:
    """Return the states of cars that stand in mode manual, a second old."""
    found = []
    for car in cars:
        messages: dict[str, Any] = {
            "state/link": pb.Link(car=car, state="online"),
            "state/mode": pb.Mode(car=car, asked="manual", inferred="manual", verdict="confirmed"),
            "state/motion": pb.Motion(car=car, motion="stop"),
            "state/safety": pb.Safety(car=car, motors="off"),
            "state/health": pb.Health(car=car, platform="arduino"),
        }
        for topic, message in messages.items():
            key = f"fleet/{car}/{topic}"
            found.append((1.0, Sample(key, message.SerializeToString(), TOPICS[topic].encoding, 0, 0)))
    return tuple(found)


async def test_plan_is_checked_as_the_parser_does(checks: PlanChecks) -> None:
    with pytest.raises(BadPlan) as found:
        parse(BAD)
    assert await is_good(checks, GOOD)
    assert await checks.check(PlanQuestion(BAD), "mia") == {"ok": False, "words": str(found.value)}
    assert not await is_good(checks, "a: \ud800 \n\x00")
    assert await is_good(checks, PLAN)
    assert len(workers()) == 1


async def test_plan_check_returns_roles_changes_and_dry_run(checks: PlanChecks) -> None:
    new = "roles:\n  guide: {mode: following, count: 1}\n  lamp: {mode: color_led, count: 2}\n"
    question = PlanQuestion(new, ("blue", "red"), here("blue", "red"), GOOD, {"red": "guide"})
    found = await checks.check(question, "mia")
    assert found["roles"] == [
        ["guide", {"mode": "following", "count": 1}],
        ["lamp", {"mode": "color_led", "count": 2}],
    ]
    assert [(each["part"], each["added"], each["removed"], each["fields"]) for each in found["changes"]] == [
        ("role guide", False, False, [["mode", "tracking", "following"]]),
        ("role lamp", True, False, [["mode", "", "color_led"], ["count", "", "2"]]),
    ]
    told = [
        (each["car"], each["role_before"], each["role"], each["decided"], each["changed"]) for each in found["cars"]
    ]
    assert told == [("blue", "", "lamp", "color_led", True), ("red", "guide", "guide", "following", True)]
    assert [(each["role"], each["decided"]) for each in found["lacking"]] == [("lamp", "1 of 2")]


async def test_plan_check_finds_fleet_file_faults_and_cuts_long_texts(checks: PlanChecks, tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("cars: {red: {}}\n")
    found = await checks.check(PlanQuestion("roles:\n  guide: {mode: tracking, cars: [rde]}\n"), "mia")
    assert not found["ok"]
    assert "rde" in found["words"]
    assert "cars" not in found, "nothing is tried"
    many = "roles:\n" + "".join(f"  r{n}: {{mode: tracking, needs: battery_v > 7}}\n" for n in range(300))
    (told,) = (await checks.check(PlanQuestion(many, ("red",), here("red")), "mia"))["cars"]
    assert len(told["why"]) <= MAX_TOLD_CHARACTERS


async def test_person_has_few_open_checks_and_others_have_theirs(checks: PlanChecks) -> None:
    mine = [asyncio.ensure_future(checks.check(PlanQuestion(PLAN), "mia")) for _ in range(MAX_OPEN_CHECKS)]
    await asyncio.sleep(0)
    assert checks.is_busy("mia")
    with pytest.raises(TooManyQuestions):
        await checks.check(PlanQuestion(GOOD), "mia")
    assert await is_good(checks, GOOD, "bob")
    assert [each["ok"] for each in await asyncio.gather(*mine)] == [True] * MAX_OPEN_CHECKS
    assert not checks.is_busy("mia")


async def test_abandoned_or_dead_plan_check_spoils_no_other(checks: PlanChecks) -> None:
    assert await is_good(checks, GOOD)
    given_up = asyncio.ensure_future(checks.check(PlanQuestion(PLAN), "mia"))
    await asyncio.sleep(0)
    given_up.cancel()
    assert not await is_good(checks, BAD), "no answer of the plan before"
    await asyncio.to_thread(wait_for, lambda: len(workers()) == 1, "the one of the plan that was given up has ended")
    for worker in workers():
        worker.kill()
    assert await is_good(checks, GOOD)


async def test_process_ends_when_nothing_was_checked_for_a_while(tmp_path: Path) -> None:
    checks = PlanChecks(tmp_path / "fleet.yaml", idle_s=0.0)
    assert await is_good(checks, GOOD)
    await asyncio.to_thread(wait_for, lambda: not workers(), "it has ended")
    assert await is_good(checks, GOOD)
    await checks.close()
