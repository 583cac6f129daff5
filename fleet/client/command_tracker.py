"""Tracks one command to some cars: collects answers and events from the bus until each car's outcome is known."""

import logging
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, Final

from fleet.client.commands import STOP_TTL_S, CommandRequest
from fleet.client.outcome import GATEWAY_RETURN_TIMEOUT_S, Outcome, Progress
from schemas import keys, messages, topics
from schemas.bus import Sample
from schemas.commands import STOPPING_VERBS

ANSWER_TIMEOUT_S: Final = 2.0
"""Timeout for a gateway's answer on a machine that is not overloaded. It does not depend on the car."""
WAIT_SAID_S: Final = 1.0
"""Time after which the user is told that a command waits for a busy car."""
SEND_AGAIN_INTERVAL_S: Final = 0.5
"""Delay before a stop is sent again, if its last query has ended without an answer. A Zenoh session that has lost its
hub tries to connect again at least as often."""
BUS_LOOK_INTERVAL_S: Final = 0.1
"""Interval at which, while a stop has no answer, it is checked whether the bus was lost."""
_MAX_QUEUED_ITEMS: Final = 4096
"""Maximum number of unread answers and events of a command. Each of up to some hundred cars sends a few."""


log = logging.getLogger("fleet")


class QueryEnded:
    """The end of the query to a car, or to all. Without `words`, nobody answered in time."""

    def __init__(self, target: str, words: str) -> None:
        self.target = target
        self.words = words


class PresenceChange:
    """The gateway of a car joined or left the bus."""

    def __init__(self, car: str, *, alive: bool) -> None:
        self.car = car
        self.alive = alive


class SupervisedCars:
    """The cars whose gateways a supervisor runs, and the cars that were on the bus when the supervisor answered.

    Without a supervisor, `names` is empty.
    """

    def __init__(self, names: frozenset[str], present: frozenset[str]) -> None:
        self.names = names
        self.present = present


CLOSED: Final = QueryEnded("", "")

Item = tuple[float, Any]
"""Time of receipt (monotonic s), and an answer (Sample), a CommandEvent or one of the classes above."""


class PendingCommand:
    """One command to some cars. `wait` runs on the caller's thread, other threads fill the inbox."""

    # A stop must not miss a car whose gateway hangs: after 2 s its token (the sign that it is on the bus) is gone, and
    # a wildcard query no longer reaches it. Therefore a stop is also for the cars that a supervisor knows, and is sent
    # again to the gateways that it starts for them. A stop could also be lost with the bus: a hub that hangs accepts
    # the query, and the query is lost when Zenoh, after 2 s without a sign of life, closes the links to the hub. So a
    # stop that a gateway has not answered is sent again when the bus is back, as long as gateways accept a stop of that
    # age (STOP_TTL_S). A car that has answered does not get the stop again, because a person may have released the car
    # meanwhile.

    def __init__(
        self,
        command_id: str,
        request: CommandRequest,
        present: list[str],
        named: list[str] | None,
        read_link: Callable[[], str],
        send_again: Callable[[str], None],
    ) -> None:
        self.id = command_id
        self.request = request
        self.queries: list[Future[None]] = []
        self.is_stop = request.verb in STOPPING_VERBS
        self._send_again = send_again
        self._present = set(present)
        self._named = named
        self._read_link = read_link
        self._link_then = read_link()
        self._link_when_gone: dict[str, str] = {}
        """For each car whose gateway was lost: our link to the hub at that moment."""
        self.arrived: Future[bool] = Future()
        """True as soon as a gateway has answered, or when `wait` ends without an answer. False if `wait` ends so
        because the bus was lost or the Fleet was closed."""
        self.lost_bus = False
        """True if the bus was lost before all gateways had answered the stop."""
        self._bus_back_at: float | None = None
        """The time at which the bus came back. None if it is still lost, or was not lost."""
        self._unanswered_at: dict[str, float] = {}
        """The time at which the last query ended, by car. It is used only for stops without an answer."""
        self.inbox: queue.Queue[Item] = queue.Queue(_MAX_QUEUED_ITEMS)
        self._asked_at = time.monotonic()
        self._is_closed = False
        self._late_at: float | None = self._asked_at + ANSWER_TIMEOUT_S
        """Time of the warning about missing answers. None after the warning."""
        self._told_to_wait: set[str] = set()
        """Busy cars that were named in a message."""
        self._progress: dict[str, Progress] = {}
        for car in present if named is None else named:
            self._of(car)
            if car not in present and not self.is_stop:
                self._progress[car].on_missing(present, self._asked_at)
        self.targets = ["*"] if named is None else [car for car in named if car in present]
        self._open_queries = len(self.targets) + self.is_stop  # a stop also asks the supervisor

    def outcomes(self) -> list[Outcome]:
        """Return the outcomes, sorted by car."""
        ended = [progress.outcome for _, progress in sorted(self._progress.items())]
        return [outcome for outcome in ended if outcome is not None]

    def wait(self) -> None:
        """Wait until every car's outcome is known or its deadline has passed."""
        while True:
            if self.is_stop:
                self._look_for_bus(time.monotonic())
            waiting = [progress for progress in self._progress.values() if progress.outcome is None]
            # A car without a token may answer a wildcard query, too. So also wait for the end of the query.
            if not waiting and not self._open_queries and not self._awaits_bus:
                self._note_arrival(arrived=not self.lost_bus and not self._is_closed)
                return
            now = time.monotonic()
            self._warn(waiting, now)
            self._give_up_late(waiting, now)
            try:
                at, item = self.inbox.get(timeout=max(0.0, self._next_look_at(waiting, now) - now))
            except queue.Empty:
                continue
            self._handle(item, at)

    def _give_up_late(self, waiting: list[Progress], now: float) -> None:
        """Give up the cars whose deadline has passed."""
        for progress in waiting:
            if progress.awaits_gateway and now >= progress.deadline and not progress.awaits_bus:
                link = self._read_link()
                if link != self._link_when_gone.get(progress.car, self._link_then):
                    # The gateway may still be there, because our own link was lost. Give it more time, but only once
                    # for each loss of our link.
                    self._link_when_gone[progress.car] = link
                    progress.on_presence(now, alive=True)
            if now >= progress.deadline and self.inbox.empty():  # after a stall of this thread, it may be there
                progress.give_up(now)

    def _next_look_at(self, waiting: list[Progress], now: float) -> float:
        """Return when `wait` has something to do, even if nothing arrives earlier."""
        due = [each.deadline for each in waiting] or [now + ANSWER_TIMEOUT_S]
        if self._late_at is not None:
            due.append(self._late_at)
        if now < (waits_at := self._asked_at + WAIT_SAID_S):
            due.append(waits_at)
        if self.is_stop and (self._awaits_bus or not all(each.answered for each in waiting)):
            due.append(now + BUS_LOOK_INTERVAL_S)
        return min(due)

    def abandon(self) -> None:
        """Make `wait` return at once, because nobody needs the outcome any more.

        The command itself is still carried out.
        """
        with suppress(queue.Full):
            self.inbox.put_nowait((time.monotonic(), CLOSED))

    def concerns(self, car: str) -> bool:
        """Return True if the command is, or may be, for this car. May run on any thread."""
        return car in self._progress or self.is_stop

    @property
    def _awaits_bus(self) -> bool:
        """True while a stop waits for the bus, and for the gateways that join it again."""
        now = time.monotonic()
        if not self.lost_bus or self._is_closed or now >= self._asked_at + STOP_TTL_S:
            return False
        return self._bus_back_at is None or now < self._bus_back_at + GATEWAY_RETURN_TIMEOUT_S

    def _look_for_bus(self, now: float) -> None:
        """Note that the bus was lost, if not all gateways have answered yet.

        If it is there, send the stop again to cars whose last query has ended without an answer.
        """
        unanswered = [each for each in self._progress.values() if each.outcome is None and not each.answered]
        if not (link := self._read_link()):
            if unanswered or not self._progress:
                self.lost_bus, self._bus_back_at = True, None
            for progress in unanswered:
                progress.on_bus_lost(now, self._asked_at + STOP_TTL_S)
            return
        if link != self._link_then and unanswered:  # the link was replaced, perhaps between two looks
            self.lost_bus = True
        if self.lost_bus and self._bus_back_at is None:
            self._bus_back_at = now
        for progress in unanswered:
            ended_at = self._unanswered_at.get(progress.car)
            if ended_at is not None and now >= ended_at + SEND_AGAIN_INTERVAL_S and progress.car in self._present:
                self._stop_again(progress)

    def _note_arrival(self, *, arrived: bool) -> None:
        if not self.arrived.done():
            self.arrived.set_result(arrived)

    def _warn(self, waiting: list[Progress], now: float) -> None:
        """Tell the user what the command still waits for, each thing once."""
        if self._late_at is not None and now >= self._late_at:
            self._late_at = None
            self._warn_of_missing_answers(waiting)
        if now >= self._asked_at + WAIT_SAID_S:
            self._warn_of_waits(waiting)

    def _warn_of_missing_answers(self, waiting: list[Progress]) -> None:
        if late := sorted(progress.car for progress in waiting if not progress.answered):
            why = "The fleet's bus does not answer" if self.lost_bus else "Computer or gateway may be overloaded"
            log.warning("%s: no answer yet, still waiting. %s.", ", ".join(late), why)

    def _warn_of_waits(self, waiting: list[Progress]) -> None:
        for progress in waiting:
            if progress.why_waiting and progress.car not in self._told_to_wait:
                self._told_to_wait.add(progress.car)
                log.warning("%s: %s", progress.car, progress.why_waiting)

    def _handle(self, item: Any, at: float) -> None:
        if item is CLOSED:
            self._open_queries = 0
            self._is_closed = True
            for progress in self._progress.values():
                progress.give_up(at)
        elif isinstance(item, QueryEnded):
            self._open_queries -= 1
            for progress in self._progress.values():
                if item.target not in ("*", progress.car):
                    continue
                self._unanswered_at[progress.car] = at
                if item.words:
                    progress.on_query_failed(item.words.replace("*", progress.car, 1), at)
                else:
                    progress.on_query_timeout(at)
        elif isinstance(item, Sample):
            key = keys.parse(item.key)
            if key is not None:
                self._on_answer(self._of(key.car), item, at)
        elif isinstance(item, PresenceChange):
            self._on_presence(item, at)
        elif isinstance(item, SupervisedCars):
            self._open_queries -= 1
            self._on_supervised(item, at)
        elif self._named is None or self.concerns(item.car):
            self._note_arrival(arrived=True)
            # If a resume ends an e-stop of the whole fleet, gateways pass it on to each other under the id of the
            # resume. So the event may be about a car to which the command was not sent.
            self._of(item.car).on_event(item.phase, item.reason, item.words, item.worst_case_s, at, item.basis)

    def _on_presence(self, change: PresenceChange, at: float) -> None:
        if change.alive:
            self._present.add(change.car)
            self._link_when_gone.pop(change.car, None)
        else:
            self._present.discard(change.car)
            self._link_when_gone.setdefault(change.car, self._read_link())
        progress = self._progress.get(change.car)
        if progress is None:
            if change.alive and self.lost_bus and self._named is None:
                self._stop_again(self._of(change.car))
            return
        was_awaited = progress.awaits_gateway
        progress.on_presence(at, alive=change.alive)
        if change.alive and was_awaited:
            self._stop_again(progress)

    def _on_supervised(self, supervised: SupervisedCars, at: float) -> None:
        """Note that these cars get new gateways. Give up on named cars that are neither supervised nor on the bus.

        Send the stop to cars on the bus that the query has missed.
        """
        queried = set(self._progress) if self._named is None else set(self.targets)
        present = self._present | supervised.present
        for car in supervised.names if self._named is None else self._named:
            progress = self._of(car)
            if car in supervised.names:
                progress.on_supervised(at, present=car in present)
            elif car not in present and not self.lost_bus:
                progress.on_missing(sorted(present), at)
            if car in present and car not in queried:
                self._stop_again(progress)

    def _stop_again(self, progress: Progress) -> None:
        """Send the stop again to a car without an answer. The first query may not have reached its gateway."""
        if self.is_stop and not progress.answered and progress.outcome is None:
            self._open_queries += 1
            self._unanswered_at.pop(progress.car, None)
            self._send_again(progress.car)

    def _on_answer(self, progress: Progress, item: Sample, at: float) -> None:
        """Handle one car's answer. A malformed answer must not affect the other cars."""
        try:
            answer: Any = messages.parse(topics.RESULT, item.payload, item.encoding)
        except messages.BadPayload as error:
            progress.on_foreign_answer(f"another program answered for {progress.car}: {error}")
            return
        self._note_arrival(arrived=True)
        progress.on_answer(answer.status, answer.reason, answer.words, answer.worst_case_s, at)

    def _of(self, car: str) -> Progress:
        """Return the progress of the command on this car. A car that was not known to be concerned is from now on."""
        if car not in self._progress:
            request = self.request
            self._progress[car] = Progress(
                car,
                request.until,
                self._asked_at,
                request.duration_s,
                verb=request.effect_verb,
                detail=request.detail,
            )
        return self._progress[car]
