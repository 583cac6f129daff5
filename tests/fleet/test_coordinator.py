"""`fleet coordinate` as a process, with real gateways: a plan is kept, and never against a hold."""

import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fleet.client import Fleet
from schemas import bus
from tests.fleet.conftest import Cars
from tests.support.processes import Process, wait_for

PLAN = """
cars: {red: tracking, green: manual}
rules:
  - when: {car: green, is: motion.motion == 'spin_left'}
    then: {who: red, mode: light_seeking}
"""


STARTED: list[Process] = []


class Lines:
    """What a coordinator has decided, last for each car."""

    def __init__(self, process: Process) -> None:
        self.process = process

    def until(self, car: str, mode: str | None, why: str) -> Any:
        while True:
            line = self.process.line()
            if (line["car"], line["mode"]) == (car, mode) and why in line["why"]:
                return line


def coordinator(cars: Cars, path: Path, plan: str = PLAN) -> Process:
    path.write_text(plan, encoding="utf-8")
    process = cars.start("-m", "fleet.cli", "coordinate", "--plan", str(path), "--json")
    STARTED.append(process)
    return process


@pytest.fixture(autouse=True)
def none_outlives_its_test() -> Iterator[None]:
    """There is one at a time: that of a test that failed would fail all that follow."""
    yield
    while STARTED:
        STARTED.pop().end()


def truth(cars: Cars, car: str) -> str:
    return str(cars.sim.say({"car": car, "ask": "truth"})["mode"])


def test_a_plan_is_kept_but_never_against_a_hold(cars: Cars, tmp_path: Path) -> None:
    seen: list[bus.Sample] = []
    cars.bus.subscribe("fleet/@coordinator/**", seen.append)
    process = coordinator(cars, tmp_path / "plan.yaml")
    lines = Lines(process)
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")
    with Fleet(cars.endpoint, sender="ann", kind="person") as client:
        # Someone's stop: the coordinator leaves the car alone, also when its mode is not the planned one.
        assert client.car("red").stop().ok
        held = lines.until("red", None, "on hold by ann")
        assert held["would_change"] == "a drive, mode or resume by a person or script"
        assert client.get("red/state/mode")[0].value.asked == "manual"
        # The end of the hold: the mode is asked for again.
        assert client.car("red").resume().ok
        lines.until("red", "tracking", "role tracking")
        wait_for(lambda: truth(cars, "red") == "tracking", "red tracks again")
        # A rule.
        drive = threading.Thread(target=lambda: client.car("green").drive("spin_left", 3.0, wait=True))
        drive.start()
        ruled = lines.until("red", "light_seeking", "rule 1")
        assert ruled["readings"][0].startswith("green/state/motion motion=spin_left (0.")
        wait_for(lambda: truth(cars, "red") == "light_seeking", "red seeks light")
        drive.join()
        lines.until("red", "tracking", "role tracking")
        # A gateway that comes back: its car is brought to its mode again.
        assert cars.gateways["red"].end() == 0
        lines.until("red", None, "not on the bus")
        cars.gateways["red"] = cars.serve("red")
        lines.until("red", "tracking", "role tracking")
        wait_for(lambda: truth(cars, "red") == "tracking", "red tracks after its gateway's return")

    second = coordinator(cars, tmp_path / "second.yaml")
    assert second.wait() == 1
    assert "fleet: fleet fleet has a coordinator already (coordinator-" in second.stderr
    assert f"-{process.pid}): stop that one first" in second.stderr

    assert process.end(signal.SIGINT) == 0
    assert "Traceback" not in process.stderr
    assert truth(cars, "red") == "tracking", "cars keep their modes"
    messages: dict[str, list[Any]] = {}
    for sample in seen:
        messages.setdefault(sample.key, []).append(sample.message())
    plan, *again = messages["fleet/@coordinator/plan"]
    assert {each.version for each in again} <= {plan.version}
    assert plan.text == PLAN
    assert plan.seq == 1
    decisions = messages["fleet/@coordinator/decision"]
    assert [each.seq for each in decisions] == list(range(1, len(decisions) + 1))
    assert {each.subject for each in decisions} == {"red", "green", "role tracking", "role manual"}
    last = messages["fleet/@coordinator/assignment"][-1]
    assert {role.name: list(role.cars) for role in last.roles} == {"manual": ["green"], "tracking": ["red"]}


def test_a_car_whose_link_is_lost_is_left_alone_and_brought_to_its_mode_when_it_is_back(
    cars: Cars, tmp_path: Path
) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "cars: {red: tracking}")
    lines = Lines(process)
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")
    cars.sim.say({"car": "red", "fault": "link_drop"})
    lost = lines.until("red", None, "the link of red is lost")
    assert lost["would_change"] == "its return"
    cars.sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: cars.state("mode").asked == "tracking", "it is asked for again")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks again")
    assert process.stderr == "", "nothing was asked of a car that could not be reached"
    assert process.end(signal.SIGTERM) == 0


def test_what_a_car_cannot_do_is_said_and_not_asked_for(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "cars: {blue: tracking, green: manual, purple: manual}")
    lines = Lines(process)
    idle = lines.until("blue", "manual", "raspberry_pi cars do not know mode tracking; they know manual")
    assert idle["kind"] == "idle"
    lines.until("purple", None, "purple is not on the bus")
    assert process.end(signal.SIGTERM) == 0
    assert process.stderr == ""


def test_a_plan_with_a_mistake_is_wrong_use(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "cars: {red: fast}")
    assert process.wait() == 2
    assert "plan.yaml:1:13: cars.red: there is no role or mode fast: there are manual, " in process.stderr
    assert process.stderr.count("\n") == 1


def test_plan_assignment_and_decisions_can_be_asked_for(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "cars: {red: manual}")
    Lines(process).until("red", "manual", "role manual")

    def known() -> dict[str, Any]:
        return {message.DESCRIPTOR.name: message for message in cars.get("fleet/@coordinator/*")}

    wait_for(lambda: len(known()) == 3, "all three answer")
    found = known()
    assert found["Plan"].text == "cars: {red: manual}"
    assert found["Decision"].subject == "red"
    assert [role.name for role in found["Assignment"].roles] == ["manual"]
