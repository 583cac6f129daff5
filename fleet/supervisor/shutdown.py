"""Shuts down gateways, each of which stops its car, and reports the result for each car.

If a gateway cannot stop its car, a new gateway tries again, until the car has stopped or a person cancels the retries.
`processes` kills hung gateways, `supervisor` decides when to shut down.
"""

from collections.abc import Callable, Mapping
from typing import Final

from fleet.client.claims import (
    NOT_CONFIRMED,
    NOT_STOPPED,
    STOP_SENT,
    STOPPED,
    describe_stop,
    may_still_move,
)
from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.process_state import GATEWAY_GRACE_S, WRONG_USE, delay_s
from fleet.supervisor.processes import ManagedProcess, ProcessSet
from schemas.words import Basis, LinkState, Motors, RunState

LAST_CLAIM_TIMEOUT_S: Final = 1.0
"""Timeout for the last state of a gateway that has ended normally. This state may arrive after the gateway's end."""
NEVER_REACHED: Final = "never reached"
"""How the result begins for a car to which no gateway had a link."""
GATEWAY_START_TIMEOUT_S: Final = 20.0
"""Timeout for the first heartbeat of a gateway that has not yet reached its car."""
NOT_TRIED: Final = "not connected yet"
"""The reason that a gateway gives for a lost link before its first attempt to open it."""
CAR_LINK_TIMEOUT_S: Final = 8.0
"""Timeout for the link to the car, from the first heartbeat."""


class GatewayShutdown:
    """The gateways that are being shut down.

    A gateway that crashed or was killed before its car stopped is always replaced once. If a gateway has ever reached
    the car, each gateway that reports that it could not stop the car is replaced, until `hurry` is called.

    `on_result` is called with a car's name and the result. `exists` returns False if the car was a simulated one whose
    simulator has ended.
    """

    def __init__(
        self,
        processes: ProcessSet,
        rows: Mapping[str, CarStatus],
        on_result: Callable[[str, str], None],
        exists: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._processes = processes
        self._rows = rows
        self._on_result = on_result
        self._exists = exists
        self._hurried = False
        self._pending: dict[str, ManagedProcess] = {}
        self._awaited: set[str] = set()
        """Gateways that get SIGTERM once they have reached their car."""
        # Several attempts may be needed: after a gateway was killed, its port may need a moment until it can be opened
        # again.
        self._tries: dict[str, int] = {}
        """Number of new gateways that were started to stop a car."""
        self._unclaimed: dict[str, float] = {}
        """Gateways that ended normally before their last state arrived, each with the time until which this state is
        awaited."""
        self.results: dict[str, str] = {}
        """Result by car. Cars that a reload removed are not in it."""

    @property
    def pending(self) -> list[str]:
        """Gateways that have not ended yet."""
        return list(self._pending)

    @property
    def not_stopped(self) -> list[str]:
        """The cars that may be moving."""
        return sorted(car for car, words in self.results.items() if may_still_move(words))

    def begin(self, process: ManagedProcess) -> None:
        """Shut down this gateway."""
        if process.name in self._pending:
            return
        self._pending[process.name] = process
        if process.status.alive and self._undecided(process):
            self._awaited.add(process.name)
        elif process.status.alive:
            self._end(process)
        elif process.child is None:
            self._finish(process, "its gateway had not started, so it got no command")
        elif process.status.state is RunState.REFUSED:
            self._finish(process, self._unstopped(process, f"no gateway was running ({process.status.words})"))
        else:
            self._replace(process, process.status.words or "no gateway was running")

    def hurry(self) -> None:
        """Stop retrying. Gateways that were never replaced still get one replacement."""
        self._hurried = True
        for name, process in list(self._pending.items()):
            if self._tries.get(name, 0) < 2 or name in self._unclaimed:
                continue
            if process.status.alive:
                self._end(process)
            else:
                self._finish(process, self.results.get(name, NOT_STOPPED))

    def recall(self, name: str) -> None:
        """Cancel the shutdown of this gateway."""
        self._forget(name)
        self.results.pop(name, None)

    def may_start(self, name: str) -> bool:
        """Return True if this gateway may start, although it is being shut down."""
        return name in self._tries

    def _forget(self, name: str) -> None:
        self._pending.pop(name, None)
        self._awaited.discard(name)
        self._unclaimed.pop(name, None)
        self._tries.pop(name, None)

    def on_exit(self, process: ManagedProcess) -> None:
        """Handle the end of a gateway: note the result or start a replacement."""
        if process.name not in self._pending or process.code is None:
            return
        words = self._unstopped(process, _why(process))
        crashed = process.code < 0 or process.status.state is RunState.WAITING
        if process.code == 0:
            self._unclaimed[process.name] = self._processes.now + LAST_CLAIM_TIMEOUT_S
            self._finish_claimed(process)
        elif process.name not in self._tries and crashed:
            self._replace(process, _why(process))
        elif self._is_retried(process):
            if not process.leaving:
                self.results[process.name] = words
            self._replace(process, words)
        else:
            self._finish(process, words)

    def _finish_claimed(self, process: ManagedProcess) -> None:
        """Finish a gateway that ended normally.

        Its last state/safety says whether readings have shown that the car stands.
        """
        row = self._rows.get(process.name)
        if row is not None and row.motors.what == Motors.OFF:
            self._finish(process, describe_stop(row.motors, process.name))
        elif self._processes.now >= self._unclaimed[process.name]:
            self._finish(process, STOP_SENT)

    def _unstopped(self, process: ManagedProcess, why: str) -> str:
        """Return the result for a car that its gateway did not stop."""
        row = self._rows.get(process.name)
        if row is None or not row.reached:
            reason = row.state.link.reason if row is not None else ""
            reason = why if reason in ("", NOT_TRIED) else reason
            return f"{NEVER_REACHED}, so it got no command ({reason.rstrip('.')})"
        if row.motors.what == Motors.OFF and row.motors.basis == Basis.SHOWN:
            return f"{STOPPED}, as it showed before its gateway ended ({why.rstrip('.')})"
        could_not_reach = process.code is None or process.code < 0 or row.state.link.state in ("", LinkState.LOST)
        return f"{NOT_STOPPED if could_not_reach else NOT_CONFIRMED}: {why}"

    def turn(self, now: float) -> None:
        """Send SIGTERM to gateways that have reached their car or exceeded their timeout."""
        for name in list(self._unclaimed):
            self._finish_claimed(self._pending[name])
        for name in sorted(self._awaited):
            process = self._pending[name]
            overdue = now - process.status.since > (
                CAR_LINK_TIMEOUT_S if process.status.state is RunState.RUNNING else GATEWAY_START_TIMEOUT_S
            )
            match process.status.state:
                case RunState.RUNNING if overdue or self._reached(process):
                    self._end(process)
                case RunState.STARTING if overdue:
                    self._end(process)
                case RunState.WAITING if now - process.status.due > GATEWAY_START_TIMEOUT_S:
                    self._finish(process, self._unstopped(process, process.status.words))

    def _is_retried(self, process: ManagedProcess) -> bool:
        """Return True if another gateway should try to stop the car. A car that was never reached does not move."""
        row = self._rows.get(process.name)
        reached = row is not None and row.reached and self._exists(process.name)
        return reached and not self._hurried and not process.leaving and process.code != WRONG_USE

    def _reached(self, process: ManagedProcess) -> bool:
        row = self._rows.get(process.name)
        if process.name in self._tries:
            return row is not None and row.state.link.state not in ("", LinkState.LOST)
        return not self._undecided(process)

    def _undecided(self, process: ManagedProcess) -> bool:
        """Return True if the gateway has not yet tried to open the link."""
        row = self._rows.get(process.name)
        link = None if row is None else row.state.link
        return process.status.state is RunState.STARTING or not link or not link.state or link.reason == NOT_TRIED

    def _replace(self, process: ManagedProcess, why: str) -> None:
        tried = self._tries[process.name] = self._tries.get(process.name, 0) + 1
        until = "" if tried == 1 else " until you press Ctrl-C or run `fleet down` again"
        self._on_result(process.name, f"{why.rstrip('.')}. A fresh gateway tries to stop the car{until}.")
        self._awaited.add(process.name)
        process.urgent = True
        process.status.schedule(self._processes.now, 0.0 if tried == 1 else delay_s(tried, 0.5))

    def _end(self, process: ManagedProcess) -> None:
        self._awaited.discard(process.name)
        self._processes.end(process, GATEWAY_GRACE_S)

    def _finish(self, process: ManagedProcess, words: str) -> None:
        self._forget(process.name)
        self._processes.end(process, 0.0)  # prevents a restart
        if not process.leaving:
            self.results[process.name] = words
        self._on_result(process.name, words)


def describe_end(results: Mapping[str, str]) -> str:
    """Describe in one line the results for all cars. `results` are those of `GatewayShutdown.results`."""
    groups = {words: sorted(car for car, said in results.items() if said.startswith(words)) for words in _RESULTS}
    bad = [f"{words}: {', '.join(groups[words])}" for words in (NOT_STOPPED, NOT_CONFIRMED) if groups[words]]
    if bad:
        return f"{'; '.join(bad)}. They may be moving: go to them."
    known = sum(len(cars) for cars in groups.values())  # the gateways of the other cars had not started
    if not known:
        return "no car had been started"
    if len(groups[STOPPED]) == known:
        return "every car that was started is stopped"
    return "; ".join(f"{words}: {', '.join(cars)}" for words, cars in groups.items() if cars)


_RESULTS: Final = (NOT_STOPPED, NOT_CONFIRMED, STOPPED, STOP_SENT, NEVER_REACHED)
"""How each result begins."""


def _why(process: ManagedProcess) -> str:
    if process.code is not None and process.code < 0:
        return "the car may be moving: its gateway was killed"
    return process.why.removeprefix(f"{process.name}: ") or f"its gateway ended with exit code {process.code}"
