"""The tutorial "What happened last week": its commands in their order, word for word. A second terminal plays the cars.

Its ports are those of the page. The lessons take as long as their faults.
"""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.e2e.test_newcomer import blocks, commands
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S

LAST_WEEK: Final = Path(__file__).parents[2] / "docs/tutorials/6-what-happened-last-week.md"
EXIT_CODES: Final = {"fleet stop red --as teacher": {1}, "fleet down": {0, 1}}
"""Commands that fail: a stop that was not shown, and the end of a fleet whose car is unreachable."""


class TwoTerminals:
    """Two terminals in one directory."""

    def __init__(self, place: Path) -> None:
        self._place = place
        bin_directory = str(Path(sys.executable).parent)
        ours = {"FLEET_ENDPOINT": free_endpoint(), "FLEET_STATE_DIR": str(place / "state")}
        self._environment = os.environ | ours | {"PATH": f"{bin_directory}:{os.environ['PATH']}"}
        self._cars: subprocess.Popen[str] | None = None

    def type(self, command: str) -> str:
        """Run a command in the first terminal; return what it printed."""
        done = subprocess.run(
            ["bash", "-c", command],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S * 4,
            check=False,
            cwd=self._place,
            env=self._environment,
        )
        assert done.returncode in EXIT_CODES.get(command, {0}), (command, done.stdout, done.stderr)
        return done.stdout

    def play(self, command: str) -> None:
        """Play the cars of a lesson in the second terminal. Those of the last one end."""
        self.end()
        self._cars = subprocess.Popen(
            ["bash", "-c", f"exec {command}"],
            stdout=subprocess.PIPE,
            text=True,
            cwd=self._place,
            env=self._environment,
        )
        assert self._cars.stdout is not None
        assert self._cars.stdout.readline().startswith("{")

    def end(self) -> None:
        """Press Ctrl-C in the second terminal."""
        if self._cars is not None:
            self._cars.send_signal(signal.SIGINT)
            self._cars.communicate(timeout=PATIENCE_S)


@pytest.fixture
def room(tmp_path: Path) -> Iterator[TwoTerminals]:
    made = TwoTerminals(tmp_path)
    try:
        yield made
    finally:
        made.end()
        made.type("fleet down; true")


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_five_questions_to_a_week_are_answered(room: TwoTerminals, tmp_path: Path) -> None:
    answers: dict[str, str] = {}
    for language, title, body in blocks(LAST_WEEK):
        if title:
            (tmp_path / title).write_text(body, encoding="utf-8")
        for command in commands(body) if language == "sh" else ():
            if command.startswith("fleet sim"):
                room.play(command)
            else:
                answers[command] = room.type(command)
    monday, wednesday, friday = sorted(each.name for each in (tmp_path / "sessions").iterdir())

    def answer(begin: str) -> str:
        return next(text for command, text in answers.items() if command.startswith(begin))

    runaway = answer('fleet find "motors').splitlines()
    assert [line.split()[:2] for line in runaway[1::2]] == [[wednesday, "red"]]
    assert re.search(rf"{wednesday} +red +teacher@", answer('fleet query "SELECT session, car, sender, words'))
    assert [line.split()[:2] for line in answer('fleet find "state').splitlines()[1::2]] == [[friday, "blue"]]
    volts = [line.split() for line in answer('fleet query "SELECT session, max(voltage_v)').splitlines()[1:]]
    assert {name: float(last) < 6.6 for name, _, last, *_ in volts} == {monday: False, wednesday: False, friday: True}
    drivers = answer('fleet query "SELECT session, person_of')
    assert re.search(rf"{monday} +mia +red +drive +1", drivers)
    assert re.search(rf"{wednesday} +mia +red +mode +1", drivers)
    marked = [line for line in answers["fleet sessions"].splitlines() if " kept" in line]
    assert [line.split()[0] for line in marked] == [wednesday]
