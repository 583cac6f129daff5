"""The end of gateways, each of which stops its car: told to end, replaced once where one cannot, and what became of it.

Killing is crew.py's part, when is supervisor.py's.
"""

import time
from collections.abc import Callable, Mapping
from typing import Final

from fleet.supervise.cars import Row
from fleet.supervise.crew import Crew, Process
from fleet.supervise.restart import State, grace_s

NOT_STOPPED: Final = "not stopped"
"""How the words begin on a car that may be moving."""
START_S: Final = 20.0
"""How long a gateway that has to reach its car first may take until it is heard."""
NOT_TRIED: Final = "not connected yet"
"""What a gateway gives as the reason of a lost link before it has tried to open it."""
LINK_S: Final = 8.0
"""How long then until it has reached its car."""


class Farewell:
    """Gateways that are to end.

    One that is killed before its car is stopped, or had fallen before it was told, is started once more for that; and
    one that has just been started may reach its car first.
    `tell` hears what became of each car (its name, words).
    """

    def __init__(self, crew: Crew, rows: Mapping[str, Row], tell: Callable[[str, str], None]) -> None:
        self._crew = crew
        self._rows = rows
        self._tell = tell
        self._going: dict[str, Process] = {}
        self._awaited: set[str] = set()
        """Those that are told when they have reached their car."""
        self._again: set[str] = set()
        """Those of them that were started once more: a port, too, may need a moment after a gateway was killed."""
        self.became: dict[str, str] = {}
        """By car; without those that are taken out while the others stay."""

    @property
    def going(self) -> list[str]:
        """Those whose end is waited for."""
        return list(self._going)

    @property
    def not_stopped(self) -> list[str]:
        """Cars that may be moving."""
        return sorted(car for car, words in self.became.items() if words.startswith(NOT_STOPPED))

    def begin(self, process: Process) -> None:
        """See that this one stops its car and ends."""
        if process.name in self._going:
            return
        self._going[process.name] = process
        if process.ward.alive and self._undecided(process):
            self._awaited.add(process.name)
        elif process.ward.alive:
            self._end(process)
        elif process.child is None:
            self._became(process, "nothing was sent to it: its gateway had not been started")
        elif process.ward.state is State.GIVEN_UP:
            self._became(process, f"{NOT_STOPPED}: no gateway was running ({process.ward.words})")
        else:
            self._once_more(process, process.ward.words or "no gateway was running")

    def recall(self, name: str) -> None:
        """This one is wanted again."""
        self._forget(name)
        self.became.pop(name, None)

    def may_start(self, name: str) -> bool:
        """Whether it is to be started although it is to end."""
        return name in self._again

    def _forget(self, name: str) -> None:
        self._going.pop(name, None)
        self._awaited.discard(name)
        self._again.discard(name)

    def ended(self, process: Process) -> None:
        """A gateway has ended."""
        if process.name not in self._going or process.code is None:
            return
        if process.code == 0:
            self._became(process, "stopped")
        elif process.name in self._again or (process.code > 0 and process.ward.state is not State.WAITING):
            killed = "its gateway was killed: the car may be moving"
            self._became(process, f"{NOT_STOPPED}: {killed if process.code < 0 else _why(process)}")
        else:
            self._once_more(process, "its gateway was killed" if process.code < 0 else _why(process))

    def turn(self, now: float) -> None:
        """Tell those to end that have reached their car now, or did not in time."""
        for name in sorted(self._awaited):
            process = self._going[name]
            overdue = now - process.ward.since > (LINK_S if process.ward.state is State.RUNNING else START_S)
            match process.ward.state:
                case State.RUNNING if overdue or self._reached(process):
                    self._end(process)
                case State.STARTING if overdue:
                    self._end(process)
                case State.WAITING if overdue:
                    self._became(process, f"{NOT_STOPPED}: {process.ward.words}")

    def _reached(self, process: Process) -> bool:
        row = self._rows.get(process.name)
        if process.name in self._again:
            return row is not None and row.link not in ("", "lost")
        return not self._undecided(process)

    def _undecided(self, process: Process) -> bool:
        """Whether it has not yet tried to reach its car."""
        row = self._rows.get(process.name)
        return process.ward.state is State.STARTING or row is None or not row.link or row.reason == NOT_TRIED

    def _once_more(self, process: Process, why: str) -> None:
        self._tell(process.name, f"{why}: another is started to stop the car")
        self._again.add(process.name)
        self._awaited.add(process.name)
        process.ward.wanted(time.monotonic())

    def _end(self, process: Process) -> None:
        self._awaited.discard(process.name)
        row = self._rows.get(process.name)
        self._crew.end(process, grace_s(row.worst_stop_s if row else None))

    def _became(self, process: Process, words: str) -> None:
        self._forget(process.name)
        self._crew.end(process, 0.0)  # it has ended: it is not started again
        if not process.leaving:
            self.became[process.name] = words
        self._tell(process.name, words)


def _why(process: Process) -> str:
    return process.why.removeprefix(f"{process.name}: ") or f"its gateway ended with exit code {process.code}"
