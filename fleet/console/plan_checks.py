"""Checks the texts of plans in a process of its own, one at a time. The process runs this module.

Checking a plan of 60 kB takes 0.14 s of Python code, or 2 s if it has 200 rules. In a thread of the console, that code
would hold the interpreter lock while a STOP waits for it. Measured: three pupils who had plans checked held it for 94 %
of the time.
"""

from base64 import b64decode, b64encode
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, Final

from fleet.console.budgets import MAX_OPEN_CHECKS
from fleet.console.plan_answer import PlanQuestion, answer_to
from fleet.console.worker import Worker, serve_lines
from fleet.coordinator.observer import listed_cars
from fleet.fleetfile.fleet_file import read_fleet
from fleet.policy.snapshot import CarSnapshot
from schemas.bus import Sample
from schemas.yaml_document.document import BadFile

PLAN_CHECK_TIMEOUT_S: Final = 30.0
"""Timeout of a check. The worst plan of 60 kB takes 2 s, or 20 s on a busy processor, because the process has a low
priority. The process needs another 1 s to start, or 10 s on a busy machine, like a coordinator."""
IDLE_CHECKER_S: Final = 60.0
"""Time after the last check at which the process ends. A person who writes a plan checks it from time to time."""


class PlanChecks:
    """The process that checks plans. `file` is the fleet file, which may not exist."""

    def __init__(self, file: Path, idle_s: float = IDLE_CHECKER_S) -> None:
        self._file = file
        self._worker = Worker(
            "fleet.console.plan_checks", timeout_s=PLAN_CHECK_TIMEOUT_S, idle_s=idle_s, max_open=MAX_OPEN_CHECKS
        )
        self.is_busy = self._worker.is_busy
        self.close = self._worker.close

    async def check(self, question: PlanQuestion, person: Hashable) -> dict[str, Any]:
        """Return the answer to the question of a page about a plan (plan_answer.answer_to). Raises TooManyQuestions."""
        samples = [
            (age_s, each.key, b64encode(each.payload).decode(), each.encoding) for age_s, each in question.samples
        ]
        asked = (question.text, question.present, samples, question.before, dict(question.roles), question.phase)
        words = f"The plan could not be checked within {PLAN_CHECK_TIMEOUT_S:g} s."
        return await self._worker.ask([str(self._file), *asked], person) or {"ok": False, "words": words}


def _question(values: list[Any]) -> PlanQuestion:
    text, present, samples, before, roles, phase = values
    taken = [(age_s, Sample(key, b64decode(payload), encoding, 0, 0)) for age_s, key, payload, encoding in samples]
    return PlanQuestion(text, tuple(present), tuple(taken), before, roles, phase)


def _listed(file: Path) -> Mapping[str, CarSnapshot]:
    try:
        return listed_cars(read_fleet(file, unbound=True)) if file.is_file() else {}
    except BadFile:  # `fleet check` says why
        return {}


if __name__ == "__main__":
    serve_lines(lambda asked: answer_to(_question(asked[1:]), _listed(Path(asked[0]))))
