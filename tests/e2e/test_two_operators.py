"""Two operators, one car: command line, SDK and record always name the one that drives.

Each operator is a process of its own. The simulated car reports its true state.
"""

import json
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.ports import free_endpoint
from tests.support.processes import LONG_S, FleetProcesses, GatewayProcess, driving, wait_for

SCRIPT = f"""
import sys, time
from fleet import Fleet, LeaseLost, NotCarriedOut
with Fleet(sender="bot") as fleet:
    try:
        with fleet.car("red").lease() as car:
            while True:
                try:
                    car.drive("spin_left", {LONG_S})
                except NotCarriedOut as error:
                    if error.outcome.reason != "stale":  # the machine was busy, so the command came too late
                        raise
    except LeaseLost as error:
        sys.exit("lost: " + str(error))
"""

LONG = f"{LONG_S:g}s"


class Record:
    """The published command events and logs of a test."""

    def __init__(self, fleet: FleetProcesses) -> None:
        self._lock = threading.Lock()
        self._events: list[Any] = []
        self._logs: list[Any] = []
        fleet.bus.subscribe("fleet/red/event/command", lambda sample: self._take(self._events, sample.message()))
        fleet.bus.subscribe("fleet/red/event/log", lambda sample: self._take(self._logs, sample.message()))

    def _take(self, kept: list[Any], message: Any) -> None:
        with self._lock:
            kept.append(message)

    def of(self, sender: str, verb: str = "drive") -> list[tuple[str, str, str]]:
        """Return phase, reason and text of each event of a sender's commands with a verb."""
        with self._lock:
            return [
                (event.phase, event.reason, event.words)
                for event in self._events
                if event.sender.startswith(sender) and event.verb == verb
            ]

    def takeovers(self) -> list[str]:
        """Return the messages about takeovers."""
        with self._lock:
            return [log.message for log in self._logs if log.name.endswith("lease_taken")]


@pytest.fixture
def sim(fleet: FleetProcesses) -> GatewayProcess:
    started, (red,) = fleet.simulate("red:arduino:tcp")
    fleet.gateway(red, "--longest-drive", f"{LONG_S:g}")
    fleet.ready()
    return started


def operator(fleet: FleetProcesses, who: str, *arguments: str) -> GatewayProcess:
    """Run a command as a person."""
    fleet.environment["LOGNAME"] = who
    return fleet.start("-m", "fleet.cli", *arguments)


def wait_for_end(process: GatewayProcess) -> tuple[int, str]:
    """Wait for the end. Return the exit code and the output: stderr, or stdout after a success."""
    code = process.wait()
    return code, (process.stderr or "\n".join(process.lines())).strip()


def row_of_fleet_list(fleet: FleetProcesses) -> dict[str, Any]:
    """Return the car's row of `fleet list --json`."""
    process = operator(fleet, "eve", "list", "--json")
    assert process.wait() == 0, process.stderr
    row: dict[str, Any] = json.loads(process.lines()[0])
    return row


def is_driver(fleet: FleetProcesses, who: str, car: str = "red") -> bool:
    """Return True if the gateway names this person as the owner of the motion."""
    motion = fleet.state("motion", car)
    return motion is not None and motion.owner.startswith(who)


def test_command_line_names_driver_after_refusal_takeover_stop(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    record = Record(fleet)
    ann = operator(fleet, "ann", "drive", "red", "forward", "--for", LONG)
    wait_for(lambda: is_driver(fleet, "ann@"), "ann drives")
    table, refused = operator(fleet, "eve", "list"), operator(fleet, "bob", "drive", "red", "back")
    row = row_of_fleet_list(fleet)
    assert row["driver"].startswith("ann@")
    assert row["driver"].endswith(f"-{ann.pid}")
    assert row["driver_kind"] == "person"
    assert table.wait() == 0
    assert "ann (person)" in table.lines()[1]

    code, words = wait_for_end(refused)
    assert code == 1
    assert words.startswith("red: refused: ")
    assert "ann (person) for another " in words
    assert words.endswith(" (--take). [leased]")
    assert is_driver(fleet, "ann@"), "a refusal changed who drives"

    bob = operator(fleet, "bob", "drive", "red", "back", "--for", LONG, "--take")
    code, words = wait_for_end(ann)
    assert code == 1
    assert words.startswith("red: ended early: ")
    assert is_driver(fleet, "bob@")
    assert driving(sim), "between the two it was driven on"
    assert row_of_fleet_list(fleet)["driver"].startswith("bob@")

    assert operator(fleet, "ann", "stop", "red").wait() == 0
    code, words = wait_for_end(bob)
    assert code == 1
    assert words.startswith("red: ended early: ")
    assert not driving(sim)
    assert row_of_fleet_list(fleet)["hold"].startswith("ann@")

    assert [(phase, reason) for phase, reason, _ in record.of("ann@")] == [
        ("asked", ""),
        ("queued", ""),
        ("sent", ""),
        ("superseded", "superseded"),
    ]
    (taken,) = record.takeovers()
    assert "by bob (person) from ann (person)" in taken


@pytest.fixture(scope="module")
def three_cars(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetProcesses]:
    """Start three cars, one for each kind of command that moves a car."""
    fleet = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("several"))
    try:
        names = ("red", "green", "blue")
        _, links = fleet.simulate(*(f"{car}:arduino:tcp" for car in names))
        for car, link in zip(names, links, strict=True):
            fleet.gateway(link, "--longest-drive", f"{LONG_S:g}", car=car)
        yield fleet
    finally:
        fleet.close()


@pytest.mark.parametrize(
    ("car", "verb", "more"), [("red", "mode", ("tracking",)), ("green", "servo", ("front", "90")), ("blue", "fan", ())]
)
def test_moving_car_can_be_taken_over_with_take(
    three_cars: FleetProcesses, car: str, verb: str, more: tuple[str, ...]
) -> None:
    three_cars.ready(car)
    ann = operator(three_cars, "ann", "drive", car, "forward", "--for", LONG)
    wait_for(lambda: is_driver(three_cars, "ann@", car), "ann drives")
    code, words = wait_for_end(operator(three_cars, "bob", verb, car, *more))
    assert (code, "(--take)" in words) == (1, True), words
    assert wait_for_end(operator(three_cars, "bob", verb, car, *more, "--take"))[0] == 0
    code, words = wait_for_end(ann)
    assert code == 1
    assert "by bob" in words


def test_person_takes_the_car_from_a_script_with_a_lease(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    record = Record(fleet)
    script = fleet.start("-c", SCRIPT)
    wait_for(lambda: is_driver(fleet, "bot"), "the script drives")
    assert (row_of_fleet_list(fleet)["driver"], row_of_fleet_list(fleet)["driver_kind"]) == ("bot", "script")

    ann = operator(fleet, "ann", "drive", "red", "forward", "--for", "10s")
    assert script.wait() == 1
    # The gateway ends the lease, or rejects its renewal. The script may see either of the two first.
    assert script.stderr.startswith("lost: red "), script.stderr
    assert "by ann" in script.stderr
    wait_for(lambda: driving(sim), "ann's frame is obeyed")
    assert is_driver(fleet, "ann@"), "the script that went stopped what ann drives"
    assert fleet.ask("drive", motion="back", sender="bot", kind="script")["reason"] == "leased"
    assert is_driver(fleet, "ann@")
    assert wait_for_end(ann)[0] == 0
    wait_for(lambda: not driving(sim), "it stands")

    assert all(reason in ("", "superseded", "leased", "stale") for _, reason, _ in record.of("bot"))
    assert "forward by ann" in next(words for phase, _, words in record.of("bot") if phase == "superseded")
    (taken,) = record.takeovers()
    assert "by ann" in taken
    assert taken.endswith("from bot (script)")


def test_killed_script_leaves_no_driving_car_and_no_lease(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    script = fleet.start("-c", SCRIPT)
    wait_for(lambda: is_driver(fleet, "bot") and driving(sim), "the script drives")
    script.kill()
    wait_for(lambda: not driving(sim), "it stands", 8.0)
    wait_for(lambda: row_of_fleet_list(fleet)["driver"] is None, "nobody has it")
