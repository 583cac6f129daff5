"""Runs the suite twice at once, and pauses its processes at random: `make stress` (POSIX).

On a busy machine, any process may be late at any line. A pause has the same effect. The tool pauses all processes of
both suites except the two controllers of pytest: workers, hubs, gateways, cars, and processes that a test left behind.
A seed repeats the times and the draws, not the processes that run at those times.

Each suite has half of the workers. With all workers, twice the processes of `make test` would share the processors,
and cars would be late without a pause.

The tool never resumes a process that a test itself has stopped. Tests stop a process by
`tests.support.processes.freeze`, which waits for the end of a pause.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

import psutil

from tests.support import scheduling

ROOT = Path(__file__).parents[2]
SUITES = ("first", "second")
RUN = "STRESS_RUN"
"""Variable in the environment of all processes of a run. A hub is no descendant of its test, so only this finds it."""
PAUSE_S = (0.010, 0.900)
"""Range of the length of a pause. Zenoh drops a session after 2 s of silence, longer than any pause."""
CONTROL_PAUSE_S = (0.010, 0.300)
"""Range of the pauses of a gateway or simulator. A gap of 0.5 s in a gateway's loop ends a drive
(docs/explanation/how-it-works.md). A car shows its stop by a pause of its reports. Longer pauses would rightly fail
each test that drives. Tests of these rules stop the process themselves."""
GAP_S = (0.0, 2.0)
"""Range of the time between the starts of two pauses. A test of some seconds sees about one pause.

With 0 to 0.4 s, two to five of 13,000 tests failed, by several pauses within one limit.
"""
LOOK_S = 1.0
"""Interval of listing the processes of the run."""
TURN_S = 0.01


class Pauses:
    """Pauses processes at random, and resumes each."""

    def __init__(self, chance: random.Random, find: Callable[[], Iterable[psutil.Process]]) -> None:
        self._chance = chance
        self._find = find
        self._found: list[psutil.Process] = []
        self._look_at = self._next_at = 0.0
        self._paused: dict[psutil.Process, float] = {}
        """Time at which each paused process resumes."""
        self.count = 0
        self.total_s = 0.0
        self.processes: set[int] = set()

    def step(self, now: float) -> None:
        """Resume, list and pause processes that are due."""
        for process in [each for each, until in self._paused.items() if until <= now]:
            self._resume(process)
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            self._found = sorted(self._find(), key=lambda each: each.pid)
        if now >= self._next_at and self._found:
            self._next_at = now + self._chance.uniform(*GAP_S)
            process, share = self._chance.choice(self._found), self._chance.random()
            self._pause(process, share, now)

    def resume_all(self) -> None:
        """Resume every process that is paused."""
        for process in list(self._paused):
            self._resume(process)

    def _pause(self, process: psutil.Process, share: float, now: float) -> None:
        """Pause a process for a share of the range of lengths, 0 to 1."""
        if process in self._paused:
            return
        with suppress(psutil.Error):  # the process has ended
            if process.status() == psutil.STATUS_STOPPED:
                return
            least, most = CONTROL_PAUSE_S if in_control(process) else PAUSE_S
            seconds = least + share * (most - least)
            self._paused[process] = now + seconds  # first, so that `resume_all` resumes it after an interrupt
            process.suspend()
            self.count += 1
            self.total_s += seconds
            self.processes.add(process.pid)

    def _resume(self, process: psutil.Process) -> None:
        with suppress(psutil.Error):
            process.resume()
        self._paused.pop(process, None)


def in_control(process: psutil.Process) -> bool:
    """Return True if a process is a gateway or a simulator, started as a module or as a command, or may become one."""
    words = process.cmdline()  # empty while the process begins its program
    return not words or any(word in ("gateway.cli", "gateway.sim") or Path(word).name == "gateway" for word in words)


def of_run(run: str, spared: Iterable[int]) -> list[psutil.Process]:
    """Return the processes of a run whose ids are not in `spared`."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # the process has ended, or belongs to another user
            if process.pid not in spared and process.environ().get(RUN) == run:
                found.append(process)
    return found


def _start(name: str, tests: list[str], directory: Path) -> subprocess.Popen[bytes]:
    options = ["-v", "-m", "not soak", "-n", "auto", "--dist", "loadgroup", "-p", "no:cacheprovider"]
    words = [sys.executable, "-m", "pytest", *tests, *options, "--basetemp", str(directory / name)]
    with (directory / f"{name}.log").open("wb") as log:
        number, suites = str(SUITES.index(name)), str(len(SUITES))
        environment = os.environ | {RUN: str(directory), scheduling.SUITE: number, scheduling.SUITES: suites}
        # A suite has its own session, and gets a Ctrl-C only from this tool, once.
        return subprocess.Popen(
            words, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


def _ended(*_: int | FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def main() -> int:
    """Run both suites. Return 0 if both pass, else 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.stress", description=__doc__)
    parser.add_argument("tests", nargs="*", default=["tests"], help="what pytest runs (default tests)")
    parser.add_argument("--seed", type=int, help="repeats the times and draws of a run (default a new one)")
    arguments = parser.parse_args()
    seed = random.SystemRandom().randrange(10**6) if arguments.seed is None else arguments.seed
    directory = ROOT / ".tmp" / f"stress-{seed}"
    directory.mkdir(parents=True, exist_ok=True)
    print(f"seed {seed} (make stress STRESS_SEED={seed}), logs in {directory.relative_to(ROOT)}", flush=True)
    signal.signal(signal.SIGTERM, _ended)
    began = time.monotonic()
    suites: dict[str, subprocess.Popen[bytes]] = {}
    controllers: set[int] = set()
    pauses = Pauses(random.Random(seed), lambda: of_run(str(directory), controllers))
    try:
        for name in SUITES:
            suites[name] = _start(name, arguments.tests, directory)
            controllers.add(suites[name].pid)
        while any(suite.poll() is None for suite in suites.values()):
            pauses.step(time.monotonic())
            time.sleep(TURN_S)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
        for suite in suites.values():
            suite.send_signal(signal.SIGINT)
    finally:
        pauses.resume_all()
    codes = [suite.wait() for suite in suites.values()]
    for process in of_run(str(directory), ()):  # hubs in their last seconds, and processes of an interrupted test
        with suppress(psutil.Error):
            process.terminate()
    for name, code in zip(suites, codes, strict=True):
        lines = (directory / f"{name}.log").read_text(errors="replace").splitlines()
        failed = [line for line in lines if line.startswith(("FAILED ", "ERROR"))]
        print("\n".join([*failed, f"{name} suite: exit {code}: {lines[-1].strip('= ') if lines else 'no output'}"]))
    print(
        f"{pauses.count} pauses of {len(pauses.processes)} processes, {pauses.total_s:.0f} s in total, "
        f"within {time.monotonic() - began:.0f} s; seed {seed}"
    )
    return 0 if codes == [0] * len(SUITES) else 1


if __name__ == "__main__":
    sys.exit(main())
