"""One command on its way to some cars: what comes in from the bus, until it is known of each car what became of it."""

import logging
import queue
import time
from collections.abc import Callable
from typing import Any, Final

from fleet.client.commands import CommandRequest
from fleet.client.outcome import Outcome, Progress
from schemas import keys, messages, topics
from schemas.bus import Sample

ANSWER_S: Final = 2.0
"""How long a gateway takes to answer at most, whatever its car does, where the machine is not overloaded."""
_QUEUE: Final = 4096  # answers and events of one command: a few for each of some hundred cars


log = logging.getLogger("fleet")


class QueryEnded:
    """The query to a car, or to all, is over; without `words` nobody answered it in time."""

    def __init__(self, target: str, words: str) -> None:
        self.target = target
        self.words = words


class PresenceChange:
    """The gateway of a car came onto the bus, or went."""

    def __init__(self, car: str, *, alive: bool) -> None:
        self.car = car
        self.alive = alive


CLOSED: Final = QueryEnded("", "")

Item = tuple[float, Any]
"""When it came (monotonic s), and a Sample (an answer), a CommandEvent, Over, or Token."""


class PendingCommand:
    """One command on its way to some cars; `wait` runs on the thread that asked and takes what others put in."""

    def __init__(
        self, request: CommandRequest, present: list[str], named: list[str] | None, hubs: Callable[[], tuple[str, ...]]
    ) -> None:
        self.request = request
        self._hubs = hubs
        self._hubs_then = hubs()
        self.inbox: queue.Queue[Item] = queue.Queue(_QUEUE)
        self._asked_at = time.monotonic()
        self._late_at: float | None = self._asked_at + ANSWER_S
        """When to warn who has not answered; None after the warning."""
        self._open = 0
        self._progress: dict[str, Progress] = {}
        for car in present if named is None else named:
            self._of(car)
            if car not in present:
                self._progress[car].missing(present, self._asked_at)
        self.targets = ["*"] if named is None else [car for car in named if car in present]
        self._open = len(self.targets)

    def outcomes(self) -> list[Outcome]:
        """What became of it, sorted by car."""
        ended = [progress.outcome for _, progress in sorted(self._progress.items())]
        return [outcome for outcome in ended if outcome is not None]

    def wait(self) -> None:
        """Until every car's outcome is known, or its deadline is over."""
        while True:
            waiting = [progress for progress in self._progress.values() if progress.outcome is None]
            # By wildcard a car may answer that showed no token yet: it counts as well, so the query must be over.
            if not waiting and not self._open:
                return
            now = time.monotonic()
            if self._late_at is not None and now >= self._late_at:
                self._late_at = None
                self._say_who_is_late(waiting)
            for progress in waiting:
                if now >= progress.deadline and self._hubs() != self._hubs_then:
                    progress.token(now, alive=True)  # it was the hub that went
                if now >= progress.deadline and self.inbox.empty():  # we may have slept while the answer came
                    progress.give_up(now)
            until = min((each.deadline for each in waiting), default=now + ANSWER_S)
            until = until if self._late_at is None else min(until, self._late_at)
            try:
                at, item = self.inbox.get(timeout=max(0.0, until - now))
            except queue.Empty:
                continue
            self._take(item, at)

    def concerns(self, car: str) -> bool:
        """Return True if this command asks this car; on any thread."""
        return car in self._progress

    def _say_who_is_late(self, waiting: list[Progress]) -> None:
        if late := sorted(progress.car for progress in waiting if not progress.heard):
            log.warning(
                "no answer yet from %s: still waiting, the machine or the gateway may be overloaded", ", ".join(late)
            )

    def _take(self, item: Any, at: float) -> None:
        if item is CLOSED:
            self._open = 0
            for progress in self._progress.values():
                progress.give_up(at)
        elif isinstance(item, QueryEnded):
            self._open -= 1
            for progress in self._progress.values():
                if item.target not in ("*", progress.car):
                    continue
                if item.words:
                    progress.silent(item.words.replace("*", progress.car, 1), at)
                else:
                    progress.unanswered(at)
        elif isinstance(item, Sample):
            key = keys.parse(item.key)
            if key is not None:
                self._answer(self._of(key.car), item, at)
        elif isinstance(item, PresenceChange):
            if item.car in self._progress:
                self._progress[item.car].token(at, alive=item.alive)
        else:
            self._of(item.car).event(item.phase, item.reason, item.words, item.worst_case_s, at, item.basis)

    def _answer(self, progress: Progress, item: Sample, at: float) -> None:
        """One car's answer; what nobody can read costs no other car its outcome."""
        try:
            answer: Any = messages.parse(topics.RESULT, item.payload, item.encoding)
        except messages.BadPayload as error:
            progress.silent(f"what answered for {progress.car} is no gateway of this fleet: {error}", at)
            return
        progress.answered(answer.status, answer.reason, answer.words, answer.worst_case_s, at)

    def _of(self, car: str) -> Progress:
        if car not in self._progress:
            self._progress[car] = Progress(car, self.request.until, self._asked_at, self.request.lasts_s)
        return self._progress[car]
