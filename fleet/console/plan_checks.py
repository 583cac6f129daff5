"""Checks the texts of plans in a process of its own, one at a time. The process runs this module.

A plan of 60 kB takes 0.14 s of Python code, and with 200 rules 2 s. In a thread of the console, that code would hold
the interpreter while a STOP waits for it: three pupils that had plans checked kept it for 94 % of the time.
"""

import asyncio
import json
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from base64 import b64decode, b64encode
from collections import Counter
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, Final

from fleet.console.budgets import MAX_OPEN_CHECKS
from fleet.console.plan_answer import PlanQuestion, answer_to
from fleet.coordinator.observer import listed_cars
from fleet.fleetfile.fleet_file import read_fleet
from fleet.policy.snapshot import CarSnapshot
from schemas.bus import Sample
from schemas.process.ending import kill
from schemas.yaml_document.document import BadFile

PLAN_CHECK_TIMEOUT_S: Final = 30.0
"""Timeout of a check. The worst plan of 60 kB takes 2 s, at the lowest share of a busy processor ten times that, and
the start of the process as long as that of a coordinator: 1 s, on a busy machine 10 s."""
IDLE_CHECKER_S: Final = 60.0
"""Time after the last check for which the process stays: a person who writes a plan checks it once in a while."""
NICENESS: Final = 10
"""The console, the gateways and the recorder go first."""
_MAX_ANSWER_BYTES: Final = 16 * 1024 * 1024
"""Maximum size of an answer: a plan of 64 KiB may have a fault in each line, with a text of 200 bytes."""


class TooManyChecks(Exception):
    """Other checks of the same person have no answer yet."""


class PlanChecks:
    """The process that checks plans. It starts with the first check, and ends when there was none for a while.

    file: the fleet file, which may not exist.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._process: Process | None = None
        self._started: list[Process] = []
        """The processes that may not have ended yet."""
        self._turn = asyncio.Lock()
        self._open: Counter[Hashable] = Counter()
        self._idle: asyncio.TimerHandle | None = None

    def is_busy(self, person: Hashable) -> bool:
        """Return True if no more checks of this person may begin."""
        return self._open[person] >= MAX_OPEN_CHECKS

    async def check(self, question: PlanQuestion, person: Hashable) -> dict[str, Any]:
        """Return what a page is told of a plan (plan_answer.answer_to). Raises TooManyChecks."""
        if self.is_busy(person):
            raise TooManyChecks
        self._open[person] += 1
        try:
            async with self._turn:
                return await self._ask(self._line(question))
        finally:
            self._open[person] -= 1
            if not self._open[person]:
                del self._open[person]

    def _line(self, question: PlanQuestion) -> bytes:
        samples = [
            (age_s, each.key, b64encode(each.payload).decode(), each.encoding) for age_s, each in question.samples
        ]
        asked = (question.text, question.present, samples, question.before, dict(question.roles), question.phase)
        return json.dumps([str(self._file), *asked]).encode() + b"\n"

    async def _ask(self, line: bytes) -> dict[str, Any]:
        if self._idle is not None:
            self._idle.cancel()
        try:
            async with asyncio.timeout(PLAN_CHECK_TIMEOUT_S):
                # The process may have died since the last check: then a new one answers.
                found = await self._answer(line) or await self._answer(line)
        except TimeoutError:
            found = None
        self._idle = asyncio.get_running_loop().call_later(IDLE_CHECKER_S, self._kill)
        words = f"The plan could not be checked within {PLAN_CHECK_TIMEOUT_S:g} s."
        return found or {"ok": False, "words": words}

    async def _answer(self, line: bytes) -> dict[str, Any] | None:
        """Return what the process answers. None if it has died."""
        # Its answer would be taken for that of the next plan if this check does not wait for it.
        process, self._process = self._process or await self._start(), None
        answered = False
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(line)
            await process.stdin.drain()
            found: dict[str, Any] = json.loads(await process.stdout.readline())
            answered = True
        except (OSError, ValueError):
            return None
        else:
            self._process = process
            return found
        finally:
            if not answered:
                kill(process)

    async def _start(self) -> Process:
        command = (sys.executable, "-m", "fleet.console.plan_checks")
        made = await asyncio.create_subprocess_exec(*command, stdin=PIPE, stdout=PIPE, limit=_MAX_ANSWER_BYTES)
        self._started = [*(each for each in self._started if each.returncode is None), made]
        return made

    def _kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            kill(process)

    async def close(self) -> None:
        """End the process."""
        if self._idle is not None:
            self._idle.cancel()
        self._kill()
        for each in self._started:
            kill(each)
            await each.wait()


def _question(values: list[Any]) -> PlanQuestion:
    text, present, samples, before, roles, phase = values
    taken = [(age_s, Sample(key, b64decode(payload), encoding, 0, 0)) for age_s, key, payload, encoding in samples]
    return PlanQuestion(text, tuple(present), tuple(taken), before, roles, phase)


def _listed(file: Path) -> Mapping[str, CarSnapshot]:
    try:
        return listed_cars(read_fleet(file, unbound=True)) if file.is_file() else {}
    except BadFile:  # `fleet check` says why
        return {}


def main() -> None:
    """Answer each line of stdin, a plan with its question as JSON, by a line of stdout. Return when stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of the terminal
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    for line in sys.stdin:
        file, *values = json.loads(line)
        sys.stdout.write(json.dumps(answer_to(_question(values), _listed(Path(file)))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
