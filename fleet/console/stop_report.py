"""The course of a STOP, car by car: stopping, shown, sent, not reached, or moving again. Pure: time is an argument.

Each car has a row of its own. The row of a car that moves again says so as long as the car moves. Then the row is
closed, because something other than this STOP ended that motion.

`now` is monotonic, s. `at_ms` is the clock of the console, ms since the epoch: pages show it.
"""

from collections.abc import Collection, Iterable
from typing import Any, Final

from fleet.client.outcome import NO_ANSWER, Outcome, bus_lost_words
from schemas import messages
from schemas.commands import STOPPING_VERBS
from schemas.words import Basis, Motors, Phase

MOVED: Final = "moved"
"""State of a car that was stopped and moves again."""
_UNDER_WAY: Final = (Phase.ASKED, Motors.STOPPING)
"""The states of a car until its result is known."""


class StopReport:
    """One STOP of the console.

    A car is `shown` only when its own readings show that it stands, and `sent` if no reading can.
    """

    def __init__(self, number: int, verb: str, sender: str, cars: Iterable[str], now: float, at_ms: int) -> None:
        self.number = number
        self.sender = sender
        self.command_id = ""
        """The id of its command, or empty if the command was not sent yet. Events of other commands do not concern this
        STOP."""
        self._verb = verb
        self._asked_at = now
        self._at_ms = at_ms
        self._result_ns: dict[str, int] = {}
        """For each car, the stamp of the event or state from which its result follows: ns of its gateway's clock."""
        self._cars: dict[str, dict[str, Any]] = {name: _entry(Phase.ASKED) for name in cars}
        self._closed: set[str] = set()
        """The cars whose rows are closed, because they moved after the STOP."""

    @property
    def over(self) -> bool:
        """True if the result of every car is known."""
        return all(entry["state"] not in _UNDER_WAY for entry in self._cars.values())

    def on_event(self, car: str, event: Any, now: float) -> None:
        """Handle a command event. Events of other commands say nothing about this STOP."""
        if event.verb not in STOPPING_VERBS or event.id != self.command_id or car in self._closed:
            return
        if event.phase in (Phase.COMPLETE, Phase.SENT):
            self._result_ns[car] = max(messages.stamp_ns(event.stamp), self._result_ns.get(car, 0))
        is_stopped = event.phase == Phase.COMPLETE or (event.phase == Phase.SENT and event.basis)
        # A car that this STOP seemed not to reach may still be stopped by it later.
        if self._is_over(car) and not (is_stopped and self._cars[car]["state"] == Phase.FAILED):
            return
        match event.phase:
            case Phase.COMPLETE:
                self._set(car, event.basis or Basis.SENT, now)
            case Phase.SENT if event.basis:
                self._set(car, event.basis, now, event.words)
            case Phase.FAILED | Phase.REJECTED | Phase.EXPIRED:
                self._set(car, Phase.FAILED, now, event.words or event.reason)
            case _:
                self._cars[car] = _entry(Motors.STOPPING)

    def on_safety(self, car: str, safety: Any, now: float) -> None:
        """Handle a new state/safety.

        The gateway of a car that was not reached may stop the car later. A car that stood may move again.
        """
        state = self._cars[car]["state"] if car in self._cars else ""
        stamp_ns = messages.stamp_ns(safety.stamp)
        is_off = safety.motors == Motors.OFF and safety.motors_basis
        if state == Phase.FAILED and is_off and self._began_since(safety, stamp_ns, now):
            self._set(car, safety.motors_basis, now)
            self._result_ns[car] = stamp_ns
        elif state in tuple(Basis) and safety.motors == Motors.ON and stamp_ns > self._result_ns.get(car, 0):
            self._cars[car] |= {"state": MOVED, "moved_at_ms": self._wall_ms(now)}
            self._result_ns[car] = stamp_ns
        elif state == MOVED and safety.motors != Motors.ON and stamp_ns > self._result_ns.get(car, 0):
            self._close(car)
        if state in _UNDER_WAY:  # remember the stamp, so that an older state cannot contradict the result later
            self._result_ns[car] = max(stamp_ns, self._result_ns.get(car, 0))

    def on_presence(self, present: Collection[str]) -> None:
        """Close the rows of cars that moved again and then lost their gateway: nobody knows whether they still move."""
        for car in [car for car, entry in self._cars.items() if entry["state"] == MOVED and car not in present]:
            self._close(car)

    def on_outcomes(self, outcomes: Iterable[Outcome], now: float, *, lost_bus: bool = False) -> None:
        """Handle the final outcomes. A car that has no outcome was not reached.

        `lost_bus` is True if the bus was lost before the stop was answered.
        """
        by_car = {outcome.car: outcome for outcome in outcomes}
        for car in {*self._cars, *by_car}:
            outcome = by_car.get(car)
            if self._is_over(car) or car in self._closed:
                continue
            if outcome is None:
                words = bus_lost_words(car) if lost_bus else "its gateway is not on the bus: look at the car"
                self._set(car, Phase.FAILED, now, words)
            elif outcome.ok:
                self._set(car, outcome.basis or Basis.SENT, now, outcome.words)
            else:
                self._set(car, Phase.FAILED, now, outcome.words or outcome.reason or NO_ANSWER)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        cars = [{"name": name, **self._cars[name]} for name in sorted(self._cars)]
        return {
            "number": self.number,
            "verb": self._verb,
            "at_ms": self._at_ms,
            "over": self.over,
            "cars": cars,
            "closed": len(self._closed),
        }

    def _began_since(self, safety: Any, stamp_ns: int, now: float) -> bool:
        """Return True if this claim about the motors began after this STOP.

        An older claim is not a result of this STOP.
        """
        if not safety.HasField("trust_since_s"):
            return False
        # Check both clocks: a bus that hung delivers old states, and the clock of another computer may be ahead.
        began_ns = stamp_ns - int(safety.trust_since_s * 1e9)
        return now - safety.trust_since_s > self._asked_at and began_ns > self._at_ms * 1_000_000

    def _close(self, car: str) -> None:
        del self._cars[car]
        self._closed.add(car)

    def _wall_ms(self, now: float) -> int:
        return self._at_ms + round((now - self._asked_at) * 1000)

    def _is_over(self, car: str) -> bool:
        return car in self._cars and self._cars[car]["state"] not in _UNDER_WAY

    def _set(self, car: str, state: str, now: float, words: str = "") -> None:
        self._cars[car] = _entry(state, round(now - self._asked_at, 2), words, self._wall_ms(now))


def _entry(state: str, took_s: float | None = None, words: str = "", at_ms: int | None = None) -> dict[str, Any]:
    return {"state": state, "took_s": took_s, "words": words, "at_ms": at_ms, "moved_at_ms": None}
