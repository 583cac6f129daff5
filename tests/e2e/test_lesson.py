"""A lesson with six cars and three groups: a lead pauses, takes a car, gives it back and lends one.

The file, the options of the gateways and the commands are those of a class. The simulated cars judge.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet.client.client import Fleet
from fleet.fleetfile.fleet_file import read_fleet
from fleet.supervisor.spec import UpOptions, build_spec
from schemas.limits import STREAM_SILENCE_S
from tests.e2e.test_newcomer import Newcomer, blocks, commands
from tests.support import in_process
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, GatewayProcess, driving, wait_for

LESSON = Path(__file__).parents[2] / "fleet/examples/fleets/lesson.yaml"
CARS = ("red", "blue", "green", "yellow", "white", "black")
LONG_S = 10.0


class Lesson:
    """Six simulated cars with their gateways, started as `fleet up` starts them, and people who type commands."""

    def __init__(self, fleet: FleetProcesses, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fleet = fleet
        spec = build_spec(read_fleet(LESSON), UpOptions())
        assert tuple(spec.cars) == CARS
        self.sim, links = fleet.simulate(*(f"{car}:arduino:tcp" for car in CARS))
        self._arguments = {car: (link, *spec.cars[car].arguments) for car, link in zip(CARS, links, strict=True)}
        self.gateways = {car: self.start(car) for car in CARS}
        for name, value in fleet.environment.items():
            monkeypatch.setenv(name, value)
        for car in CARS:
            fleet.ready(car)
        self._people: dict[str, Fleet] = {}

    def start(self, car: str) -> GatewayProcess:
        """Start the gateway of a car."""
        return self.fleet.gateway(*self._arguments[car], car=car)

    def type(self, person: str, *words: str) -> str:
        """Type a command as a person, and check that it succeeds. Return its output."""
        done = in_process.fleet(*words, "--as", person)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def refused(self, person: str, *words: str) -> str:
        """Type a command that the gateway rejects. Return the message."""
        done = in_process.fleet(*words, "--as", person)
        assert done.returncode == 1, done.stdout
        return done.stderr

    def hold_down(self, person: str, car: str) -> None:
        """Begin a long drive, and wait until the car drives. After a stop, a sender must pause for half a second."""
        if person not in self._people:
            self._people[person] = Fleet(self.fleet.endpoint, person=person, kind="person")
        driver = self._people[person].car(car)
        outcome = driver.drive("forward", LONG_S, wait=False)
        if outcome.reason == "held":
            time.sleep(2 * STREAM_SILENCE_S)
            outcome = driver.drive("forward", LONG_S, wait=False)
        outcome.check()
        wait_for(lambda: driving(self.sim, car), f"{car} drives")

    def moving(self) -> set[str]:
        """Return the cars whose motors are on, by the cars' own answers."""
        return {car for car in CARS if driving(self.sim, car)}

    def close(self) -> None:
        """Close the clients of all people."""
        for person in self._people.values():
            person.close()


@pytest.fixture
def lesson(fleet: FleetProcesses, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lesson]:
    began = Lesson(fleet, monkeypatch)
    yield began
    began.close()


@pytest.mark.soak
def test_lesson_with_six_cars(lesson: Lesson) -> None:
    # Each group drives its own cars. Everyone may stop all cars.
    lesson.hold_down("group_a", "red")
    words = lesson.refused("group_b", "drive", "red", "forward")
    assert "group_b may not " in words
    assert words.endswith("[not_allowed]\n")
    assert "list zoe" in lesson.refused("zoe", "drive", "red", "forward")
    assert lesson.moving() == {"red"}
    lesson.type("zoe", "stop", "red")
    assert lesson.moving() == set(), "who is not listed may stop"
    assert "a lead" in lesson.refused("group_a", "pause")

    # Everybody, stop and listen.
    lesson.hold_down("group_a", "red")
    lesson.hold_down("group_c", "white")
    said = lesson.type("teacher", "pause", "--why", "look at the board")
    assert lesson.moving() == set()
    assert all(f"{car}: stopped" in said or f"{car}: stop sent" in said for car in CARS)
    words = lesson.refused("group_a", "drive", "red", "forward")
    assert "teacher" in words
    assert "look at the board" in words
    assert words.endswith("[paused]\n")
    for verb in (("mode", "blue", "tracking"), ("light", "blue", "red"), ("speed", "blue", "up"), ("unpause",)):
        lesson.refused("group_a", *verb)
    assert lesson.moving() == set()
    lesson.gateways["red"].end()
    lesson.gateways["red"] = lesson.start("red")
    lesson.fleet.ready("red")
    assert "[paused]" in lesson.refused("group_a", "drive", "red", "forward"), "a pause outlives the gateway"

    # The lead shows something with a car of group c, and gives it back.
    lesson.hold_down("teacher", "white")
    assert lesson.moving() == {"white"}
    lesson.type("teacher", "stop", "white")
    assert lesson.moving() == set()
    lesson.type("teacher", "unpause")
    assert lesson.moving() == set(), "the end of a pause moves nothing"
    assert "a lead" in lesson.refused("group_c", "drive", "white", "forward"), "the lead stopped it"
    assert "teacher" in lesson.refused("group_c", "resume", "white", "--all")
    lesson.type("teacher", "resume", "--all")
    lesson.hold_down("group_c", "white")
    lesson.type("group_c", "stop")

    # Group a gets a car of group b for a while.
    assert (
        "[bad_value]" in in_process.fleet("lend", "green", "--to", "grup_a", "--for", "10m", "--as", "teacher").stderr
    )
    lesson.type("teacher", "lend", "green", "--to", "group_a", "--for", "10m")
    lesson.hold_down("group_a", "green")
    assert "[lent]" in lesson.refused("group_b", "drive", "green", "forward")
    (row,) = (json.loads(line) for line in lesson.type("zoe", "list", "green", "--json").splitlines())
    assert (row["lent"], row["driver"].partition("@")[0]) == ("group_a", "group_a")
    assert lesson.moving() == {"green"}
    lesson.type("teacher", "lend", "green", "--end")
    wait_for(lambda: not lesson.moving(), "the end of the loan stops the car that the borrower drives")
    assert "[not_allowed]" in lesson.refused("group_a", "drive", "green", "forward")
    lesson.hold_down("group_b", "green")

    # An emergency stop of the lead ends only with the lead.
    lesson.type("teacher", "estop", "--why", "a finger")
    assert lesson.moving() == set()
    assert "a finger" in lesson.refused("group_b", "resume", "--all")
    assert lesson.moving() == set()
    lesson.type("teacher", "resume", "--all")
    lesson.hold_down("group_b", "green")
    assert lesson.moving() == {"green"}


TUTORIAL = Path(__file__).parents[2] / "docs/tutorials/5-a-lesson-with-six-cars.md"


@pytest.mark.soak
@pytest.mark.timeout(400)
def test_tutorial_word_for_word(tmp_path: Path) -> None:
    """Each command does what the page says. Commands with `# refused` exit with 1."""
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    variables = {"PATH": programs, "FLEET_ENDPOINT": free_endpoint(), "FLEET_STATE_DIR": str(tmp_path / "state")}
    student = Newcomer(tmp_path, os.environ | variables)
    lines = [line for language, _, body in blocks(TUTORIAL) if language == "sh" for line in body.splitlines()]
    lines.remove("fleet console --as teacher --open")  # stays: test_console_people.py opens it
    down = lines.pop()
    try:
        for line in lines:
            (command,) = commands(line)
            if "# refused" in line:
                assert not student.succeeds(command), line
            else:
                student.type(command)
    finally:
        student.type(down)
