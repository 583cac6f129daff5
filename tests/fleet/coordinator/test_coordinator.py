"""`fleet plan run` as a process with real gateways. It enforces a plan, but never against a hold."""

import json
import os
import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fleet.client.client import Fleet, default_sender
from schemas import bus
from schemas.keys import person_of
from tests.fleet.conftest import Cars, asked
from tests.support.processes import LONG_S, GatewayProcess, driving, wait_for
from tests.support.up import fleet_command

PLAN = """
fixed: {red: {mode: tracking}, green: {mode: manual}}
rules:
  - when: {car: green, is: motion.motion == 'spin_left'}
    then: {who: red, mode: light_seeking}
"""


STARTED: list[GatewayProcess] = []


class Lines:
    """The decisions of a coordinator, for each car in order. The order between two cars is random."""

    def __init__(self, process: GatewayProcess) -> None:
        self.process = process
        self._passed: dict[str, list[Any]] = {}

    def until(self, car: str, mode: str | None, why: str) -> Any:
        while True:
            line = self._next(car)
            if line["mode"] == mode and why in line["why"]:
                return line

    def _next(self, car: str) -> Any:
        """Return the next line of this car. Store the lines of other cars for later calls."""
        if passed := self._passed.get(car):
            return passed.pop(0)
        while (line := self.process.line())["car"] != car:
            self._passed.setdefault(line["car"], []).append(line)
        return line


def coordinator(cars: Cars, path: Path, plan: str = PLAN, *more: str) -> GatewayProcess:
    path.write_text(plan, encoding="utf-8")
    process = cars.start("-m", "fleet.cli", "plan", "run", str(path), "--json", *more)
    STARTED.append(process)
    return process


@pytest.fixture(autouse=True)
def none_outlives_its_test() -> Iterator[None]:
    """End the coordinator of a failed test. There is one at a time, so it would fail all later tests."""
    yield
    while STARTED:
        STARTED.pop().end()


def truth(cars: Cars, car: str) -> str:
    return str(cars.sim.say({"car": car, "ask": "truth"})["mode"])


def tracking(cars: Cars, path: Path) -> Lines:
    """Start a plan, and wait until its car tracks. Return the further decisions."""
    lines = Lines(coordinator(cars, path, "fixed: {red: {mode: tracking}}"))
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")
    return lines


def test_plan_is_kept_but_never_against_a_hold(cars: Cars, tmp_path: Path) -> None:
    seen: list[bus.Sample] = []
    cars.bus.subscribe("fleet/@coordinator/**", seen.append)
    process = coordinator(cars, tmp_path / "plan.yaml")
    lines = Lines(process)
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")
    with Fleet(cars.endpoint, sender="ann", kind="person") as client:
        # A person stops the car. The coordinator leaves it alone, also if its mode is not the planned one.
        client.car("red").stop().check()
        held = lines.until("red", None, "on hold by ann")
        assert held["would_change"].endswith(" (`fleet resume red`)")
        assert client.get("red/state/mode")[0].value.asked == "manual"
        # The hold ends. The coordinator requests the mode again.
        client.car("red").resume().check()
        lines.until("red", "tracking", "role tracking")
        wait_for(lambda: truth(cars, "red") == "tracking", "red tracks again")
        # A rule.
        drive = threading.Thread(target=lambda: asked(lambda: client.car("green").drive("spin_left", LONG_S)))
        drive.start()
        ruled = lines.until("red", "light_seeking", "rule 1")
        assert re.match(r"green/state/motion motion=spin_left \(\d+\.", ruled["readings"][0])
        wait_for(lambda: truth(cars, "red") == "light_seeking", "red seeks light")
        client.car("green").drive("stop").check()
        drive.join()
        lines.until("red", "tracking", "role tracking")
        # A gateway comes back. The coordinator brings its car to its mode again.
        assert cars.gateways["red"].end() == 0
        lines.until("red", None, "not on the bus")
        cars.gateways["red"] = cars.serve("red")
        lines.until("red", "tracking", "role tracking")
        wait_for(lambda: truth(cars, "red") == "tracking", "red tracks after its gateway's return")

    second = coordinator(cars, tmp_path / "second.yaml")
    assert second.wait() == 1
    assert f"-{process.pid})" in second.stderr
    assert "(coordinator-" in second.stderr

    # The car shows its stop after 9 s, with a busy machine also later than the coordinator waits. Then that is said.
    assert process.end(signal.SIGINT) == ("NOT CONFIRMED: red" in process.stderr)
    assert "Traceback" not in process.stderr
    assert (truth(cars, "red"), driving(cars.sim, "red")) == ("manual", False), "Ctrl-C brings its cars to rest"
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
    *_, last = [each for each in messages["fleet/@coordinator/assignment"] if not each.stopped_by]
    assert {role.name: list(role.cars) for role in last.roles} == {"manual": ["green"], "tracking": ["red"]}


def test_car_with_lost_link_is_left_alone_and_restored_to_mode(cars: Cars, tmp_path: Path) -> None:
    lines = tracking(cars, tmp_path / "plan.yaml")
    process = lines.process
    cars.sim.say({"car": "red", "fault": "link_drop"})
    lost = lines.until("red", None, "the link of red is lost")
    assert "link is back" in lost["would_change"]
    cars.sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
    lines.until("red", "tracking", "role tracking")
    wait_for(lambda: cars.state("mode").asked == "tracking", "it is asked for again")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks again")
    assert process.stderr == "", "nothing was asked of a car that could not be reached"
    assert process.end(signal.SIGTERM) == 0


def test_unsupported_role_is_explained_and_not_asked_for(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(
        cars, tmp_path / "plan.yaml", "fixed: {blue: {mode: tracking}, green: {mode: manual}, purple: {mode: manual}}"
    )
    lines = Lines(process)
    idle = lines.until("blue", "manual", "raspberry_pi cars do not know mode tracking; they know manual")
    assert idle["kind"] == "idle"
    lines.until("purple", None, "purple is not on the bus")
    assert process.end(signal.SIGTERM) == 0
    assert process.stderr == ""


def test_plan_with_a_mistake_is_wrong_use(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "fixed: {red: {role: fast}}")
    assert process.wait() == 2
    assert "plan.yaml:1:21: error: fixed.red.role: " in process.stderr
    assert process.stderr.count("\n") == 1


def test_plan_assignment_and_decisions_can_be_asked_for(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "fixed: {red: {mode: manual}}")
    Lines(process).until("red", "manual", "role manual")

    def known() -> dict[str, Any] | None:
        answers = [each for each in cars.get("fleet/@coordinator/*") if not isinstance(each, str)]
        named = {getattr(each, "subject", each.DESCRIPTOR.name): each for each in answers}
        return named if len(named) == 4 else None

    found = wait_for(known, "all four answer")
    assert found["Plan"].text == "fixed: {red: {mode: manual}}"
    assert found["red"].decided == "manual"
    assert found["role manual"].decided == "1 of 1"
    assert [role.name for role in found["Assignment"].roles] == ["manual"]


TEAM = """
roles:
  scout: {mode: tracking}
  rest: {mode: manual, count: all, priority: -1}
"""


def test_why_explains_decision_and_plan_is_replaced_atomically(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", TEAM)
    lines = Lines(process)
    lines.until("green", "manual", "role rest")
    lines.until("red", "tracking", "role scout")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")
    why = cars.start("-m", "fleet.cli", "why", "red", "--json")
    told = why.line()
    assert (told["decided"], told["kind"], told["role"]) == ("tracking", "role", "scout")
    assert why.wait() == 0
    assert told["since"] <= told["stamp"]
    said = cars.start("-m", "fleet.cli", "why", "red")
    assert said.wait() == 0
    assert re.match(r"red: tracking, for 0:0\d:\d\d \(since \d\d:\d\d:\d\d \S+\)", said.lines()[0]), said.stderr
    nobody = cars.start("-m", "fleet.cli", "why", "purple")
    assert nobody.wait() == 1
    assert "about purple" in nobody.stderr
    assert "blue, green, red" in nobody.stderr

    key = "fleet/@coordinator/@cmd/plan"
    (refused,) = cars.bus.query(key, payload=b"fixed: {red: {role: fast}}\nroles: {x: {}}", timeout_s=5.0)
    assert isinstance(refused, bus.Sample)
    answer: Any = refused.message()
    assert (answer.status, answer.reason) == ("rejected", "bad_value")
    assert "roles.x.mode: is missing" in answer.words
    (plan,) = cars.get("fleet/@coordinator/plan")
    assert plan.text == TEAM, "nothing is half applied"

    changed = TEAM + "  dance: {mode: light_seeking, cars: [red], priority: 5}\n"
    (taken,) = cars.bus.query(key, payload=changed.encode(), timeout_s=5.0)
    assert isinstance(taken, bus.Sample)
    assert taken.message().status == "sent"  # type: ignore[attr-defined]  # a fleet.v1.Result
    lines.until("red", "light_seeking", "role dance")
    wait_for(lambda: truth(cars, "red") == "light_seeking", "red seeks light")
    assert process.end(signal.SIGTERM) == 0


PHASES = """
roles: {line: {mode: tracking, cars: [red]}, light: {mode: light_seeking, cars: [red]}}
phases: {first: {roles: [line], timeout_s: 600, next: second}, second: {roles: [light]}}
"""


def test_person_steps_phase_stops_and_restarts_plan(cars: Cars, tmp_path: Path) -> None:
    events: list[Any] = []
    cars.bus.subscribe("fleet/@coordinator/log", lambda sample: events.append(sample.message()))

    def plan(*words: str) -> "subprocess.CompletedProcess[str]":
        return fleet_command("plan", *words, environment={"FLEET_ENDPOINT": cars.endpoint})

    lines = Lines(coordinator(cars, tmp_path / "plan.yaml", PHASES))
    lines.until("red", "tracking", "role line")
    said = plan("next").stdout.split()
    assert (said[1], said[-1]) == ("first", "second")
    lines.until("red", "light_seeking", "role light")
    refused = plan("next")
    assert (refused.returncode, "Phase second " in refused.stderr) == (1, True)
    assert refused.stderr.endswith("[unsupported]\n")
    wait_for(lambda: truth(cars, "red") == "light_seeking", "red seeks light")
    shown = plan("show").stdout
    assert "second (of first, second)" in shown
    assert "role light (light_seeking): red, 1 of 1" in shown

    assert ": red brought to rest" in plan("stop").stdout
    wait_for(lambda: truth(cars, "red") == "manual", "red rests")
    lines.until("red", None, "stopped the plan")
    lines.process.kill()
    lines.process.wait()
    wait_for(lambda: not cars.bus.tokens("fleet/@coordinator"), "the hub has noticed")
    again = Lines(coordinator(cars, tmp_path / "plan.yaml", PHASES))
    again.until("red", None, "stopped the plan")
    # The next coordinator brings it to rest once more, if the last one was killed before it knew that red rests.
    wait_for(lambda: truth(cars, "red") == "manual" and cars.state("mode").asked == "manual", "red rests on")
    assert json.loads(plan("show", "--json").stdout)["stopped_by"]
    assert not cars.state("safety").HasField("hold"), "anyone may drive it"

    assert plan("restart").returncode == 0
    again.until("red", "tracking", "role line")
    (tmp_path / "other.yaml").write_text("fixed: {red: {mode: manual}}")
    assert plan("set", str(tmp_path / "other.yaml")).returncode == 0
    again.until("red", "manual", "role manual")
    (tmp_path / "other.yaml").write_text("fixed: {red: {role: fast}}")
    wrong = plan("set", str(tmp_path / "other.yaml"))
    assert wrong.returncode == 2
    assert f"{tmp_path / 'other.yaml'}:1:21: error: " in wrong.stderr
    assert again.process.end(signal.SIGTERM) == 0
    wait_for(lambda: len(events) == 4, "each request is an event")
    codes = [each.name.removeprefix("@coordinator ") for each in events]
    assert codes == ["plan_next", "plan_stopped", "plan_restarted", "plan_set"]
    assert {each.message.split()[0] for each in events} == {person_of(default_sender())}
    assert "`fleet plan run FILE`" in plan("show").stderr


LISTED = """
cars:
  red: {platform: arduino, roles: [scout]}
  green: {platform: raspberry_pi}
  blue: {platform: raspberry_pi}
"""
NEVER = "fixed: {purple: {mode: tracking}}\nroles: {ghost: {mode: tracking, cars: [green]}}"


def test_unreachable_plan_is_refused_at_start_and_over_bus(cars: Cars, tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(LISTED, encoding="utf-8")
    listed = ("--fleet-file", str(file))
    told = (
        "1:9: error: car purple: the fleet file has no such car. There are blue, green, red.",
        "2:9: error: role ghost: no car can fill it",
    )
    refused = coordinator(cars, tmp_path / "never.yaml", NEVER, *listed)
    assert refused.wait() == 2
    assert all(f"{tmp_path / 'never.yaml'}:{each}" in refused.stderr for each in told), refused.stderr
    assert "Traceback" not in refused.stderr
    alone = coordinator(cars, tmp_path / "alone.yaml", "roles: {ghost: {mode: manual, platforms: [stm32]}}", *listed)
    assert alone.wait() == 2, "nor is one that only the cars of the fleet file cannot do"

    process = coordinator(cars, tmp_path / "plan.yaml", "roles: {scout: {mode: tracking}}", *listed)
    lines = Lines(process)
    lines.until("red", "tracking", "role scout")
    key = "fleet/@coordinator/@cmd/plan"
    for plan, expected in ((NEVER, told), ("roles: {x: {mode: arm}}", ("roles.x.mode",))):
        (sample,) = cars.bus.query(key, payload=plan.encode(), timeout_s=5.0)
        assert isinstance(sample, bus.Sample)
        answer: Any = sample.message()
        assert (answer.status, answer.reason) == ("rejected", "bad_value")
        assert all(each in answer.words for each in expected), answer.words
    (in_force,) = cars.get("fleet/@coordinator/plan")
    assert in_force.text == "roles: {scout: {mode: tracking}}"
    # A role of the fleet file that is not in the plan may be a typo. The coordinator only reports it.
    (sample,) = cars.bus.query(key, payload=b"roles: {scouts: {mode: manual}}", timeout_s=5.0)
    assert isinstance(sample, bus.Sample)
    answer = sample.message()
    assert answer.status == "sent"
    assert "warning: car red: " in answer.words
    assert "role scout" in answer.words
    assert process.end(signal.SIGTERM) == 0
    assert "car red: " in process.stderr
    assert "role scout" in process.stderr


def test_successor_of_killed_coordinator_switches_no_mode(cars: Cars, tmp_path: Path) -> None:
    # The coordinator of the test before may have requested a mode that red still opens.
    wait_for(lambda: cars.state("safety", "red").trust != "stopping", "red changes no mode")
    process = coordinator(cars, tmp_path / "plan.yaml", TEAM)
    Lines(process).until("red", "tracking", "role scout")
    wait_for(lambda: truth(cars, "red") == "tracking", "red tracks")

    def tracks() -> bool:
        mode = cars.state("mode", "red")
        return (mode.asked, mode.verdict) == ("tracking", "confirmed")

    wait_for(tracks, "its gateway confirms the mode")  # the next coordinator requests an unconfirmed mode again
    asked: list[bus.Sample] = []
    cars.bus.subscribe("fleet/*/event/command", asked.append)
    modes: list[bus.Sample] = []
    cars.bus.subscribe("fleet/red/state/mode", modes.append)
    process.kill()
    process.wait()
    wait_for(lambda: not cars.bus.tokens("fleet/@coordinator"), "its token is gone")
    following = coordinator(cars, tmp_path / "plan.yaml", TEAM)
    Lines(following).until("red", "tracking", "role scout (1 of 1): it had it before")
    # A request of the coordinator would arrive before this stop.
    with Fleet(cars.endpoint, sender="ann", kind="person") as client:
        client.car("blue").stop().check()
    Lines(following).until("blue", None, "on hold by ann")

    def told() -> list[Any]:
        events: list[Any] = [sample.message() for sample in asked]
        # Events of the first coordinator's commands may arrive late.
        return [each for each in events if not each.sender.endswith(f"-{process.pid}")]

    wait_for(told, "the stop is heard here, too")
    commanded = {(each.car, each.verb) for each in told()}
    states: list[Any] = [each.message() for each in modes]
    if any(each.verdict != "confirmed" for each in states):  # a busy machine: its readings came late
        commanded.discard(("red", "mode"))
    assert commanded == {("blue", "stop")}
    with Fleet(cars.endpoint, sender="ann", kind="person") as client:
        client.car("blue").resume().check()
    assert truth(cars, "red") == "tracking"
    assert following.end(signal.SIGTERM) == 0
    assert (truth(cars, "red"), driving(cars.sim, "red")) == ("manual", False)


def test_second_signal_at_once_does_not_take_back_the_stop(cars: Cars, tmp_path: Path) -> None:
    process = tracking(cars, tmp_path / "plan.yaml").process
    os.kill(process.pid, signal.SIGINT)
    process.end(signal.SIGINT)
    wait_for(lambda: truth(cars, "red") == "manual" and not driving(cars.sim, "red"), "red stands")


def test_end_waits_for_a_link_that_is_gone(cars: Cars, tmp_path: Path) -> None:
    lines = tracking(cars, tmp_path / "plan.yaml")
    process = lines.process
    cars.sim.say({"car": "red", "fault": "link_drop"})
    lines.until("red", None, "the link of red is lost")
    os.kill(process.pid, signal.SIGINT)
    wait_for(lambda: any(each.stopped_by for each in cars.get("fleet/@coordinator/assignment")), "it stops the plan")
    cars.sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
    assert process.wait() == 0
    assert (truth(cars, "red"), driving(cars.sim, "red")) == ("manual", False)


def test_car_whose_gateway_is_gone_at_the_end_is_named(cars: Cars, tmp_path: Path) -> None:
    lines = tracking(cars, tmp_path / "plan.yaml")
    process = lines.process
    cars.gateways["red"].kill()
    lines.until("red", None, "not on the bus")
    os.kill(process.pid, signal.SIGINT)
    wait_for(lambda: any(each.stopped_by for each in cars.get("fleet/@coordinator/assignment")), "it stops the plan")
    assert process.end(signal.SIGINT) == 1
    assert "NOT CONFIRMED: red may still be moving" in process.stderr
    cars.gateways["red"] = cars.serve("red")
    cars.ready("red")


def test_role_goes_to_another_car_when_a_gateway_dies(cars: Cars, tmp_path: Path) -> None:
    process = coordinator(cars, tmp_path / "plan.yaml", "roles: {watch: {mode: manual, cars: [green, blue]}}")
    lines = Lines(process)
    lines.until("green", "manual", "role watch")
    killed = cars.gateways["green"]
    killed.kill()
    killed.wait()
    lines.until("green", None, "green is not on the bus; its role watch is kept for 1.5 s")
    lines.until("blue", "manual", "role watch (1 of 1): in place of green: green is not on the bus")
    cars.gateways["green"] = cars.serve("green")
    cars.ready("green")
    lines.until("green", "manual", "no role for it: watch: it has its car: blue")
    assert process.end(signal.SIGTERM) == 0


def test_car_that_does_not_react_at_the_end_is_named_and_next_ctrl_c_ends_at_once(cars: Cars, tmp_path: Path) -> None:
    lines = tracking(cars, tmp_path / "plan.yaml")
    process = lines.process
    cars.sim.say({"car": "red", "fault": "deaf"})
    try:
        os.kill(process.pid, signal.SIGINT)
        lines.until("red", "manual", "red is brought to rest")
        restart = fleet_command("plan", "restart", environment={"FLEET_ENDPOINT": cars.endpoint})
        assert "is ending" in restart.stderr
        assert process.end(signal.SIGINT) == 1
        assert "NOT CONFIRMED: red may still be moving" in process.stderr
    finally:
        cars.sim.say({"car": "red", "fault": "deaf", "for_s": 0})
