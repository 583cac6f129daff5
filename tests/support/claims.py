"""Judges the claims of gateways about simulated cars by the cars' true motors and modes. Times: ns since the epoch.

All processes of a test share one clock, and the judge compares the publishers' stamps after the run. A message that
arrives late on a busy machine is no fault.
"""

import threading
from dataclasses import dataclass, field
from typing import Any, Final

from schemas.bus import Bus, Sample
from tests.support.judge import stamp_ns

FALSE_S: Final = 0.3
"""Maximum time for which a claim about motors or a result may be false."""
VERDICT_S: Final = 5.5
"""Maximum time for which an ended mode may stay confirmed (tests/fuzz/stop_search.py)."""
STATE_S: Final = 1.5
"""Lifetime of a claim. Gateways publish each second, and a killed gateway claims nothing."""
TRUTH_GAP_S: Final = 0.5
"""Maximum interval between two truths. In a longer gap, the true state is unknown. Simulators publish ten a second."""

MOTORS: Final = "motors off, shown, while they run"
VERDICT: Final = "mode confirmed, another is true"
RESULT: Final = "stop complete, while the motors run"
SENT: Final = "motors off, sent, while they run"
"""Not a false claim, because the basis `sent` promises no evidence. It is counted beside the others."""
KINDS: Final = (MOTORS, VERDICT, RESULT)

_S: Final = 1_000_000_000


@dataclass(slots=True)
class Span:
    """A time for which a value was true, or claimed."""

    begin: int
    end: int
    value: str

    def shared_s(self, other: "Span") -> float:
        """Return the overlap of two spans, s. A negative value is the gap between them."""
        return (min(self.end, other.end) - max(self.begin, other.begin)) / _S


@dataclass
class _CarClaims:
    """The true states of one car, and the claims about it."""

    motors: list[Span] = field(default_factory=list)
    modes: list[Span] = field(default_factory=list)
    safety: list[tuple[int, str]] = field(default_factory=list)
    verdicts: list[tuple[int, str]] = field(default_factory=list)
    complete: list[tuple[int, str]] = field(default_factory=list)


@dataclass
class Claims:
    """The claims about all cars of a bus. Call `follow` before the first command, and `false` after the last one."""

    cars: dict[str, _CarClaims] = field(default_factory=dict)
    results: int = 0
    """Number of stops and e-stops that ended as complete."""
    shown: int = 0
    """Number of times that `motors` became `off` with the basis `shown`."""
    confirmed: int = 0
    """Number of times that a mode became confirmed."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def follow(cls, bus: Bus) -> "Claims":
        """Subscribe to the truth, the states and the commands of all cars."""
        claims = cls()
        bus.subscribe("fleet/*/sim/truth", claims._truth)
        bus.subscribe("fleet/*/state/safety", claims._safety)
        bus.subscribe("fleet/*/state/mode", claims._mode)
        bus.subscribe("fleet/*/event/command", claims._command)
        return claims

    def false(self) -> dict[str, list[str]]:
        """Return the false claims as texts, by kind."""
        found: dict[str, list[str]] = {kind: [] for kind in (*KINDS, SENT)}
        with self._lock:
            for name, car in sorted(self.cars.items()):
                on = [span for span in _whole(car.motors) if span.value == "on"]
                said = _spans(car.safety)
                found[MOTORS] += _overlaps(name, [each for each in said if each.value == "off shown"], on)
                found[SENT] += _overlaps(name, [each for each in said if each.value == "off sent"], on)
                modes = _whole(car.modes)
                for claim in (each for each in _spans(car.verdicts) if each.value):
                    other = _merged([span for span in modes if span.value != claim.value])
                    found[VERDICT] += _overlaps(name, [claim], other, VERDICT_S)
                for at, identity in car.complete:
                    span = next((each for each in on if each.begin <= at <= each.end), None)
                    if span is not None and span.end - at > FALSE_S * _S:
                        found[RESULT].append(f"{name}: {identity} at {at}, motors on for {(span.end - at) / _S:.1f} s")
        return found

    def __str__(self) -> str:
        counts = [f"{self.shown} rests shown, {self.confirmed} modes confirmed, {self.results} stops complete"]
        counts += [f"{len(each):4} {kind}" for kind, each in self.false().items()]
        return "\n".join(counts)

    # ------------------------------------------------------------------ subscribers

    def _car(self, name: str) -> _CarClaims:
        return self.cars.setdefault(name, _CarClaims())

    def _truth(self, sample: Sample) -> None:
        truth: Any = sample.message()
        at = stamp_ns(truth)
        with self._lock:
            car = self._car(truth.car)
            _extend(car.motors, at, "on" if truth.motor_left or truth.motor_right else "off")
            _extend(car.modes, at, truth.mode)

    def _safety(self, sample: Sample) -> None:
        safety: Any = sample.message()
        value = f"{safety.motors} {safety.motors_basis}"
        with self._lock:
            said = self._car(safety.car).safety
            self.shown += value == "off shown" and (not said or said[-1][1] != value)
            said.append((stamp_ns(safety), value))

    def _mode(self, sample: Sample) -> None:
        mode: Any = sample.message()
        value = mode.asked if mode.verdict == "confirmed" else ""
        with self._lock:
            said = self._car(mode.car).verdicts
            self.confirmed += bool(value) and (not said or said[-1][1] != value)
            said.append((stamp_ns(mode), value))

    def _command(self, sample: Sample) -> None:
        event: Any = sample.message()
        if event.phase == "complete" and event.verb in ("stop", "estop"):
            with self._lock:
                self.results += 1
                self._car(event.car).complete.append((stamp_ns(event), f"{event.verb} {event.id}"))


def _extend(spans: list[Span], at: int, value: str) -> None:
    last = spans[-1] if spans else None
    if last is None or at - last.end > TRUTH_GAP_S * _S:
        spans.append(Span(at, at, value))
        return
    last.end = max(last.end, at)
    if last.value != value:
        spans.append(Span(at, at, value))


def _whole(spans: list[Span]) -> list[Span]:
    return [span for span in spans if span.end > span.begin]


def _spans(said: list[tuple[int, str]]) -> list[Span]:
    """Return the spans of the claimed values."""
    spans: list[Span] = []
    ordered = sorted(said)
    for number, (at, value) in enumerate(ordered):
        end = at + int(STATE_S * _S)
        if number + 1 < len(ordered):
            end = min(end, ordered[number + 1][0])
        spans.append(Span(at, end, value))
    return _merged(spans, same=True)


def _merged(spans: list[Span], *, same: bool = False) -> list[Span]:
    """Join spans without a gap between them. `same`: join only spans of the same value."""
    joined: list[Span] = []
    for span in spans:
        last = joined[-1] if joined else None
        if last is not None and last.end == span.begin and (last.value == span.value or not same):
            last.end = span.end
        else:
            joined.append(Span(span.begin, span.end, span.value))
    return joined


def _overlaps(name: str, claims: list[Span], truths: list[Span], over_s: float = FALSE_S) -> list[str]:
    return [
        f"{name}: {claim.value} while {truth.value}, {seconds:.2f} s from {max(claim.begin, truth.begin)} on"
        for claim in claims
        for truth in truths
        if (seconds := claim.shared_s(truth)) > over_s
    ]
