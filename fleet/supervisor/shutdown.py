"""Ends gateways, each of which stops its car, and says what became of each car.

A gateway that cannot stop its car is replaced, again and again until the car is stopped or a person ends that. Killing
is crew.py's part, when is supervisor.py's.
"""

from collections.abc import Callable, Mapping
from typing import Final

from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.processes import ManagedProcess, ProcessSet
from fleet.supervisor.restart_policy import GATEWAY_GRACE_S, WRONG_USE, RunState, delay_s

NOT_STOPPED: Final = "not stopped"
"""How the words begin on a car that may be moving."""
START_S: Final = 20.0
"""How long a gateway that has to reach its car first may take until it is heard."""
NOT_TRIED: Final = "not connected yet"
"""What a gateway gives as the reason of a lost link before it has tried to open it."""
LINK_S: Final = 8.0
"""How long then until it has reached its car."""


class GatewayShutdown:
    """Gateways that are to end.

    A gateway that is killed before its car is stopped, or that fell before it was told to end, is replaced once in any
    case. One that says that its car was not stopped is replaced until `hurry`, if the car was ever reached.
    `tell` hears what became of each car (its name, words). `exists` says whether there is such a car: a simulated car
    goes with its simulator.
    """

    def __init__(
        self,
        crew: ProcessSet,
        rows: Mapping[str, CarStatus],
        tell: Callable[[str, str], None],
        exists: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._crew = crew
        self._rows = rows
        self._tell = tell
        self._exists = exists
        self._hurried = False
        self._going: dict[str, ManagedProcess] = {}
        self._awaited: set[str] = set()
        """Gateways that are told to end when they have reached their car."""
        self._tries: dict[str, int] = {}
        """Fresh gateways that were started to stop a car. A port, too, may need a moment after a gateway was killed."""
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

    def begin(self, process: ManagedProcess) -> None:
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
        elif process.ward.state is RunState.REFUSED:
            self._became(process, f"{NOT_STOPPED}: no gateway was running ({process.ward.words})")
        else:
            self._replace(process, process.ward.words or "no gateway was running")

    def hurry(self) -> None:
        """Replace no gateway any more, but for the first time; those that try again stop their cars now or never."""
        self._hurried = True
        for name, process in list(self._going.items()):
            if self._tries.get(name, 0) < 2:
                continue
            if process.ward.alive:
                self._end(process)
            else:
                self._became(process, self.became.get(name, NOT_STOPPED))

    def recall(self, name: str) -> None:
        """This one is wanted again."""
        self._forget(name)
        self.became.pop(name, None)

    def may_start(self, name: str) -> bool:
        """Whether it is to be started although it is to end."""
        return name in self._tries

    def _forget(self, name: str) -> None:
        self._going.pop(name, None)
        self._awaited.discard(name)
        self._tries.pop(name, None)

    def ended(self, process: ManagedProcess) -> None:
        """A gateway has ended."""
        if process.name not in self._going or process.code is None:
            return
        words = f"{NOT_STOPPED}: {_why(process)}"
        fell = process.code < 0 or process.ward.state is RunState.WAITING
        if process.code == 0:
            self._became(process, "stopped")
        elif process.name not in self._tries and fell:
            self._replace(process, _why(process))
        elif self._is_retried(process):
            if not process.leaving:
                self.became[process.name] = words
            self._replace(process, words)
        else:
            self._became(process, words)

    def turn(self, now: float) -> None:
        """Tell those to end that have reached their car now, or did not in time."""
        for name in sorted(self._awaited):
            process = self._going[name]
            overdue = now - process.ward.since > (LINK_S if process.ward.state is RunState.RUNNING else START_S)
            match process.ward.state:
                case RunState.RUNNING if overdue or self._reached(process):
                    self._end(process)
                case RunState.STARTING if overdue:
                    self._end(process)
                case RunState.WAITING if now - process.ward.due > START_S:
                    self._became(process, f"{NOT_STOPPED}: {process.ward.words}")

    def _is_retried(self, process: ManagedProcess) -> bool:
        """Return True if another gateway may do what this one could not. A car that was off all the time stands."""
        row = self._rows.get(process.name)
        reached = row is not None and row.reached and self._exists(process.name)
        return reached and not self._hurried and not process.leaving and process.code != WRONG_USE

    def _reached(self, process: ManagedProcess) -> bool:
        row = self._rows.get(process.name)
        if process.name in self._tries:
            return row is not None and row.link not in ("", "lost")
        return not self._undecided(process)

    def _undecided(self, process: ManagedProcess) -> bool:
        """Whether it has not yet tried to reach its car."""
        row = self._rows.get(process.name)
        return process.ward.state is RunState.STARTING or row is None or not row.link or row.reason == NOT_TRIED

    def _replace(self, process: ManagedProcess, why: str) -> None:
        tried = self._tries[process.name] = self._tries.get(process.name, 0) + 1
        until = "" if tried == 1 else " until Ctrl-C is pressed or fleet down is called again"
        self._tell(process.name, f"{why}. A fresh gateway tries to stop the car{until}.")
        self._awaited.add(process.name)
        process.urgent = True
        process.ward.wanted(self._crew.now, 0.0 if tried == 1 else delay_s(tried, 0.5))

    def _end(self, process: ManagedProcess) -> None:
        self._awaited.discard(process.name)
        self._crew.end(process, GATEWAY_GRACE_S)

    def _became(self, process: ManagedProcess, words: str) -> None:
        self._forget(process.name)
        self._crew.end(process, 0.0)  # it has ended: it is not started again
        if not process.leaving:
            self.became[process.name] = words
        self._tell(process.name, words)


def _why(process: ManagedProcess) -> str:
    if process.code is not None and process.code < 0:
        return "its gateway was killed: the car may be moving"
    return process.why.removeprefix(f"{process.name}: ") or f"its gateway ended with exit code {process.code}"
