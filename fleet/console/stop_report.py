"""The course of a STOP, car by car: stopping, shown, sent, or not reached. Pure: time is an argument (s, monotonic)."""

from collections.abc import Iterable
from typing import Any

from fleet.client.claims import SENT
from fleet.client.outcome import NO_ANSWER, Outcome
from schemas.commands import STOPS


class StopReport:
    """One STOP of the console. A car is `shown` only when its own readings show that it stands."""

    def __init__(self, number: int, verb: str, sender: str, cars: Iterable[str], now: float, at_ms: int) -> None:
        self.number = number
        self.sender = sender
        self._verb = verb
        self._asked_at = now
        self._at_ms = at_ms
        self._cars: dict[str, dict[str, Any]] = {name: _entry("asked") for name in cars}

    @property
    def over(self) -> bool:
        """True if the result of every car is known."""
        return all(entry["state"] not in ("asked", "stopping") for entry in self._cars.values())

    def on_event(self, car: str, event: Any, now: float) -> None:
        """Handle a command event of the sender of this STOP."""
        if event.verb not in (*STOPS, "pause") or self._is_over(car):
            return
        match event.phase:
            case "complete":
                self._set(car, event.basis or SENT, now)
            case "sent" if event.basis:
                self._set(car, event.basis, now, event.words)
            case "failed" | "rejected" | "expired":
                self._set(car, "failed", now, event.words or event.reason)
            case _:
                self._cars[car] = _entry("stopping")

    def on_safety(self, car: str, safety: Any, now: float) -> None:
        """Handle a new state/safety: a car that was not reached may be stopped by its own gateway later."""
        if (
            car in self._cars
            and self._cars[car]["state"] == "failed"
            and safety.motors == "off"
            and safety.motors_basis
        ):
            self._set(car, safety.motors_basis, now)

    def on_outcomes(self, outcomes: Iterable[Outcome], now: float) -> None:
        """Handle the final outcomes. A car without an outcome was not reached."""
        by_car = {outcome.car: outcome for outcome in outcomes}
        for car in {*self._cars, *by_car}:
            outcome = by_car.get(car)
            if self._is_over(car):
                continue
            if outcome is None:
                self._set(car, "failed", now, "its gateway is not on the bus: look at the car")
            elif outcome.ok:
                self._set(car, outcome.basis or SENT, now, outcome.words)
            else:
                self._set(car, "failed", now, outcome.words or outcome.reason or NO_ANSWER)

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        cars = [{"name": name, **self._cars[name]} for name in sorted(self._cars)]
        return {"number": self.number, "verb": self._verb, "at_ms": self._at_ms, "over": self.over, "cars": cars}

    def _is_over(self, car: str) -> bool:
        return car in self._cars and self._cars[car]["state"] not in ("asked", "stopping")

    def _set(self, car: str, state: str, now: float, words: str = "") -> None:
        self._cars[car] = _entry(state, round(now - self._asked_at, 2), words)


def _entry(state: str, took_s: float | None = None, words: str = "") -> dict[str, Any]:
    return {"state": state, "took_s": took_s, "words": words}
