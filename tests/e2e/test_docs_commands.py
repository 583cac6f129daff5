"""Runs the commands and programs of docs/ word for word. test_newcomer and test_lesson run README and tutorials.

Commands for recordings run on generated sessions, the others on one simulated fleet of all pages. NOT_RUN has the
exceptions with their reasons. tests/test_documented.py parses all commands.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from gateway.capture import CapturedBytes, CaptureWriter
from tests.e2e.test_last_week import LAST_WEEK
from tests.e2e.test_lesson import TUTORIAL
from tests.e2e.test_newcomer import NOT_RUN as NOT_TYPED
from tests.e2e.test_newcomer import TRIED, blocks, commands
from tests.fleet.replay.make_session import make
from tests.support.ports import free_endpoint
from tests.support.up import fleet_command

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = [page for page in sorted((ROOT / "docs").rglob("*.md")) if page not in (*TRIED, TUTORIAL, LAST_WEEK)]
VECTORS: Final = ROOT / "tests/vectors/recorded"

NOT_RUN: Final = {
    r"fleet (scan|bind|init --yes).*": "searches the USB ports and the radio of this machine",
    r".*/dev/ttyUSB0.*": "needs a car on USB",
    r"gateway run .*ble://.*": "needs a car on Bluetooth; tests/gateway/link/test_ble_gateway.py has one",
    r".*192\.168\.1\.2:.*|ssh .*|zenohd .*": "needs a second computer",
    r"fleet replay|fleet replay (?!.*--save).*|fleet view( --web)?": "opens a window",
    r".*/media/disk.*": "needs a second disk",
    r"(gateway|fleet) .* tank( .*)?": "needs a tank; tests/e2e/test_second_family.py drives one",
    r"sudo .*": "changes this computer; tests/soak/test_install_car.py runs the script below a directory",
    r"docker .*": "needs a container engine; tests/deploy/test_containers.py checks the file",
    r"fleet exporter( --address .*)?": "stays until Ctrl-C; tests/e2e/test_exporter.py runs it",
    r"fleet foxglove( --address .*)?": "stays until Ctrl-C; tests/e2e/test_foxglove.py runs it",
    r"(FLEET_MQTT_PASSWORD=\S+ )?fleet mqtt.*": "needs a broker; tests/soak/test_mqtt.py has one",
    r"zbarcam .*": "needs a camera",
    r"fleet (hub|join|leave).*|.*--secure": "makes a hub of this computer; tests/e2e/test_secure_up.py runs it",
    r"eval .*": "is for a shell; tests/fleet/commands/test_shells.py runs it",
    r"fleet demo.*": "tests/fleet/test_demo.py runs it",
    r"fleet up.*": "stays or starts another fleet; tests/e2e/test_up.py and test_newcomer.py run it",
    r"fleet console.*": "stays, or changes who may open the console; tests/fleet/console runs it",
    r"fleet (logs .*--follow|watch.*|record( --.*| run.*)?|play.*|plan run.*|sim .*)": "stays until Ctrl-C",
    r".*--fleet lions.*": "needs the fleet lions, which another command starts",
    r"fleet (keys|view).* --for \d\ds": "takes long",
    **{re.escape(command): why for command, why in NOT_TYPED.items() if not command.startswith("fleet up")},
}
"""Patterns of commands that do not run here, with the reasons."""
RUN: Final = (
    "fleet check",
    "fleet watch red/sensor/light --when left --count 1",
)
"""Commands that run although a pattern of NOT_RUN matches."""
OTHER_RESULTS: Final = {
    "fleet plan try latest plan.yaml": "now: ",
    "fleet plan try new.yaml": "now: ",
    "fleet plan try latest~1 new.yaml": "now: ",
    "fleet servo blue vertical up": "do not know servo action vertical_up",
    "fleet doctor": "Type: ",
    "fleet doctor red": "Type: ",
    "fleet doctor latest": "Type: ",
    "fleet find 'range_m < 0.3'": "was never true",
    "fleet find 'range_m < 0.1' --mark --csv > near.csv": "was never true",
    "fleet find 'not (line.left_inner or line.right_inner)' --car red --for 2s --since monday": "was never true",
    "fleet resume": "still emergency-stopped",
    "fleet resume red": "still emergency-stopped",
    "fleet resume red blue --id 5f0c2e": "has no e-stop 5f0c2e",
    "fleet sessions at 14:05": "No session ran at 14:05",
    "fleet why red --session latest --at 14:05": "is not in the session",
    "fleet sessions redecode": "",
    "fleet sessions vector --car red --from 10s --to 20s --out tracking.jsonl": "",
    "fleet sessions verify": "went back",
    "fleet sessions verify latest": "went back",
    "fleet sessions verify latest~1": "went back",
}
"""Commands that may exit with 1 or 2, with the text that they print then.

The recorded plan was another one. Only a Raspberry Pi car has this servo. An e-stop is in force, and none has this id.
Generated sessions have no raw bytes, and their clocks jump.
"""
FIRST: Final = ("fleet wait", "fleet watch")
"""Commands before all others, while red has the wall ahead."""
LAST: Final = (
    "fleet plan try",
    "fleet arm",
    "fleet fan",
    "fleet estop",
    "fleet resume",
    "fleet lend",
    "fleet pause",
    "fleet unpause",
)
"""Commands after all others, in this order. A car with its fan on is silent, and an e-stop rejects the rest."""

WORLD: Final = """
boxes: [{x_m: 0.4, y_m: 0, width_m: 0.1, depth_m: 1}]
cars: {red: {x_m: 0.1, y_m: 0}, green: {x_m: 0, y_m: 3}, blue: {x_m: 0, y_m: -3}}
lamps: {beacon: {x_m: 0.6, y_m: 0.4, overhead: true}}
"""
"""Red has a wall ahead and a lamp at its left, so that the conditions of the pages are true."""
FLEET: Final = """
groups: {a: [red, blue], b: [green]}
world: world.yaml
defaults: {platform: arduino+arm}
cars: {red: {link: sim}, green: {link: sim}, blue: {link: sim}}
"""
PLAN: Final = """
roles: {patrol: {mode: manual, count: 2}, guide: {mode: manual}}
phases: {one: {roles: [patrol, guide], timeout_s: 900, next: two}, two: {roles: [guide], timeout_s: 900, next: one}}
"""
FILES: Final = {
    "fleet.yaml": FLEET,
    "lab.yaml": FLEET,
    "world.yaml": WORLD,
    **dict.fromkeys(("plan.yaml", "new.yaml", "other.yaml"), PLAN),
}
SESSION_S: Final = 120
TRIES: Final = 5
"""Maximum number of times that a person types a command that says to try again."""


def lines() -> dict[str, str]:
    """Return each command of these pages with the first page that has it."""
    found: dict[str, str] = {}
    for page in PAGES:
        for language, _, body in blocks(page):
            for command in commands(body) if language == "sh" else ():
                found.setdefault(command, str(page.relative_to(ROOT)))
    return found


LINES: Final = lines()


def place_in_order(command: str) -> int:
    """Return a number by which the commands are sorted."""
    if command.startswith(FIRST):
        return -1
    return next((at for at, words in enumerate(LAST, 1) if command.startswith(words)), 0)


def of_sessions(command: str) -> bool:
    """Return True for a command that reads recordings or needs no fleet."""
    words = ("sessions", "find", "replay", "example", "schema", "--version", "init")
    return command.startswith(("gateway", *(f"fleet {word}" for word in words)))


def quick() -> Iterator[str]:
    """Yield the commands that run in `make test`."""
    for command in LINES:
        if command in RUN or not any(re.fullmatch(pattern, command) for pattern in NOT_RUN):
            yield command


def gateway_command(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run `gateway` as a process, which is short."""
    return subprocess.run([sys.executable, "-m", "gateway", *arguments], capture_output=True, text=True, check=False)


class Prompt:
    """A person in a directory with files. Commands run in this process, and `Prompt` does the work of the shell."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.environment = {"FLEET_ENDPOINT": free_endpoint(), "FLEET_STATE_DIR": str(place / "state")}
        for name, text in FILES.items():
            (place / name).write_text(text, encoding="utf-8")

    def type(self, command: str) -> str:
        """Run a command that must succeed; return what it printed."""
        printed = []
        for part in re.split(r"&&|;", command):
            typed, _, file = part.strip().partition(" > ")
            words = shlex.split(typed)
            environment = dict(self.environment)
            while "=" in words[0]:
                name, _, value = words.pop(0).partition("=")
                environment[name] = value
            program, *arguments = words
            with contextlib.chdir(self.place):
                if program == "gateway":
                    done = gateway_command(*arguments)
                else:
                    for _ in range(TRIES):
                        done = fleet_command(*arguments, environment=environment)
                        if "Try again" not in done.stderr and "[stale]" not in done.stderr:
                            break
            expected = OTHER_RESULTS.get(command)
            other = expected is not None and done.returncode in (1, 2) and expected in done.stdout + done.stderr
            assert done.returncode == 0 or other, (LINES.get(command), command, done.stdout, done.stderr)
            if file:
                (self.place / file).write_text(done.stdout, encoding="utf-8")
            printed.append(done.stdout)
        return "".join(printed)


@pytest.fixture
def prompt(tmp_path: Path) -> Prompt:
    return Prompt(tmp_path)


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_each_command_of_the_pages_on_one_simulated_fleet(prompt: Prompt) -> None:
    for_fleet = [command for command in quick() if not of_sessions(command) and command != "fleet down"]
    ordered = sorted(for_fleet, key=place_in_order)
    prompt.type("fleet up --plan plan.yaml --detach")
    try:
        for command in ordered:
            prompt.type(command)
        assert (prompt.place / "range.csv").read_text(encoding="utf-8").startswith("time,key")
    finally:
        prompt.type("fleet down")


STAYS: Final = r"fleet (logs .*--follow|watch (?!.*--count).*|record( --.*| run.*)?|play.*|plan run.*|sim .*)"
CTRL_C_S: Final = 10.0
"""Timeout for the end after Ctrl-C."""


def interrupted(command: str, prompt: Prompt) -> tuple[int, str]:
    """Press Ctrl-C after the first line of a command that stays. Return its exit code and its output."""
    words = [sys.executable, "-u", "-m", "fleet.cli", *shlex.split(command)[1:]]
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=prompt.place,
        env=os.environ | prompt.environment,
    ) as process:
        assert process.stdout is not None
        try:
            first = process.stdout.readline()
            process.send_signal(signal.SIGINT)
            rest, _ = process.communicate(timeout=CTRL_C_S)
        finally:
            process.kill()
    return process.returncode, first + rest


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_each_command_that_stays_ends_with_ctrl_c(prompt: Prompt) -> None:
    """Its exit code is 130, or 0 if Ctrl-C is the usual end. The pages name both."""
    stays = [
        command
        for command in LINES
        if re.fullmatch(STAYS, command) and not re.search(r"/media/disk|fleet-replay|event/command", command)
    ]
    of_recorder = [command for command in stays if command.startswith("fleet record")]
    others = [command for command in stays if command.startswith(("fleet play", "fleet sim", "fleet plan run"))]
    ended = {}
    prompt.type("fleet up --detach")
    try:
        for command in stays:
            if command not in (*of_recorder, *others):
                ended[command] = interrupted(command, prompt)
    finally:
        prompt.type("fleet down")
    for command in others:
        ended[command] = interrupted(command, prompt)
    prompt.type("fleet up --no-record --detach")
    try:
        for command in of_recorder:
            ended[command] = interrupted(command, prompt)
    finally:
        prompt.type("fleet down")
    for command, (code, printed) in ended.items():
        assert "Traceback" not in printed, (command, printed)
        assert code == (130 if command.startswith(("fleet logs", "fleet watch")) else 0), (command, printed)
    assert len(ended) > 15


def test_each_command_of_the_pages_on_made_sessions(prompt: Prompt) -> None:
    for name in ("20260101T000000Z-fleet", "20260102T000000Z-fleet", "NAME"):
        directory = prompt.place / "sessions" / name
        directory.mkdir(parents=True)
        make(directory / "0001.mcap", SESSION_S)
    capture = CaptureWriter(prompt.place / "morning.jsonl", "/dev/ttyUSB0", "2026-01-01T00:00:00Z")
    capture.add(CapturedBytes(0.5, b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM11#"))
    capture.close()
    (prompt.place / "tests/vectors").mkdir(parents=True)
    (prompt.place / "tests/vectors/recorded").symlink_to(VECTORS)
    for command in quick():
        if of_sessions(command):
            for made in ("red", "part", "tables", "rescued", "1-patrol.yaml", "fleet.yaml", "plan.yaml"):
                path = prompt.place / made
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
            prompt.type(command)

    (program,) = (body for page in PAGES for kind, _, body in blocks(page) if kind == "python" and "Session(" in body)
    with contextlib.chdir(prompt.place), contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(program, {})
    assert len(printed.getvalue().splitlines()) > 30


def test_tables_name_no_command_that_is_gone() -> None:
    every = {*LINES, *NOT_TYPED}
    for pattern in NOT_RUN:
        assert any(re.fullmatch(pattern, command) for command in every), pattern
    assert {*RUN, *OTHER_RESULTS} - every == set()
