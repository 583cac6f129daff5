"""The lanes of a time line: for each car its modes, drivers, holds, stops and losses over time. Pure.

The console draws them live, and for a session. Times are by one clock that the caller chooses, ns since the epoch. For
a session this is the recorder's clock, because the clock of a gateway may be wrong.

A state lasts until the next one. If that one comes only after the state is stale, the state ends with its own message.
So nothing is drawn for times without messages.
A stop begins when it arrived, and ends with its last event.
"""

from collections import deque
from collections.abc import Container, Iterator
from enum import StrEnum
from typing import Any, Final

from msgspec import Struct, field

from fleet.recording.stop_count import stops_cars
from fleet.recording.tools.stop_findings import asked_by
from schemas import keys
from schemas.rights import binding_pause
from schemas.topics import TOPICS
from schemas.words import UNKNOWN, LinkState, Motion, Phase, Verdict

LANE_TOPICS: Final = ("state/mode", "state/motion", "state/safety", "state/link", "event/command")
MARK_TOPIC: Final = f"{keys.RECORDER}/mark"
MODE_TOPIC: Final = TOPICS["state/mode"]
assert MODE_TOPIC.stale_after_s is not None
HELD_NS: Final = round(MODE_TOPIC.stale_after_s * 1e9)
"""Time after which a state is stale. It is the same for all states of a car."""
MAX_SPANS: Final = 4096
"""Maximum number of spans of one lane. The oldest are forgotten. Even if a car changes each second, this is enough for
more than an hour."""
MAX_OPEN_STOPS: Final = 64
"""Maximum number of stops without an end that are kept for a car. A stop has no end if its last event was lost."""
NOT_HEARD: Final = "not heard"
"""Words of a loss during which the car's gateway published nothing."""
_MOVING: Final = frozenset(Motion) - {Motion.STOP}
_BAD_ENDS: Final = frozenset({Phase.FAILED, Phase.EXPIRED, Phase.REJECTED})
_LAST_PHASES: Final = _BAD_ENDS | {Phase.COMPLETE, Phase.SUPERSEDED}


class Lane(StrEnum):
    """The lanes of a car, from top to bottom."""

    MODE = "mode"
    DRIVER = "driver"
    HOLD = "hold"
    STOP = "stop"
    LOSS = "loss"


class LaneSpan(Struct):
    """A mode, driver, hold, stop or loss from `begin_ns` to `end_ns`. The end grows while it lasts."""

    car: str
    lane: Lane
    begin_ns: int
    end_ns: int
    words: str
    bad: bool = False

    def as_list(self) -> list[Any]:
        """Return the span as JSON values, with times in ms."""
        return [self.car, self.lane, self.begin_ns // 1_000_000, self.end_ns // 1_000_000, self.words, self.bad]


class LaneMark(Struct, frozen=True):
    """A mark that somebody set."""

    at_ns: int
    words: str
    by: str = ""


class Lanes(Struct):
    """The lanes of all cars, from their messages in the order of their times."""

    spans: dict[tuple[str, Lane], deque[LaneSpan]] = field(default_factory=dict)
    marks: deque[LaneMark] = field(default_factory=lambda: deque(maxlen=MAX_SPANS))
    _stops: dict[str, dict[str, LaneSpan]] = field(default_factory=dict)
    """By car and id: the stops that have no end yet."""
    _open: dict[tuple[str, Lane], LaneSpan] = field(default_factory=dict)
    """The span of each lane that the next state may prolong."""
    _heard_ns: dict[str, int] = field(default_factory=dict)
    """When the last state of each car's link came."""

    def add(self, car: str, topic: str, message: Any, at_ns: int) -> None:
        """Add a message of LANE_TOPICS, or a mark. Other messages change nothing."""
        match topic:
            case "state/mode":
                is_wrong = message.verdict == Verdict.CONTRADICTED
                mode = message.inferred if is_wrong else message.asked
                self._hold(car, Lane.MODE, "" if mode == UNKNOWN else mode, at_ns, bad=is_wrong)
            case "state/motion":
                self._hold(car, Lane.DRIVER, message.owner if message.motion in _MOVING else "", at_ns)
            case "state/safety":
                self._hold(car, Lane.HOLD, _kept_by(message), at_ns, bad=len(message.estops) > 0)
            case "state/link":
                is_lost = message.state in (LinkState.LOST, LinkState.STALE)
                self._hold(car, Lane.LOSS, message.state if is_lost else "", at_ns, bad=is_lost)
                self._silence(car, at_ns)
            case "event/command" if stops_cars(message):
                self._stop(car, message, at_ns)
            case _ if topic == MARK_TOPIC:
                self.marks.append(LaneMark(at_ns, message.message, message.name))

    def keep(self, cars: Container[str]) -> None:
        """Forget all cars but these."""
        for found in (self.spans, self._open):
            for place in [place for place in found if place[0] not in cars]:
                del found[place]
        for by_car in (self._stops, self._heard_ns):
            for car in [car for car in by_car if car not in cars]:
                del by_car[car]

    def since(self, at_ns: int) -> Iterator[LaneSpan]:
        """Yield the spans that reach this time or are later, ordered by car, lane and time."""
        for _, spans in sorted(self.spans.items()):
            yield from (span for span in spans if span.end_ns >= at_ns)

    def silences(self, now_ns: int) -> Iterator[LaneSpan]:
        """Yield a loss for each car that has been silent for too long by now.

        `add` adds a loss only when the car is heard again, and perhaps it never is.
        """
        for car, heard_ns in sorted(self._heard_ns.items()):
            if now_ns - heard_ns > HELD_NS:
                yield LaneSpan(car, Lane.LOSS, heard_ns, now_ns, NOT_HEARD, bad=True)

    def at(self, at_ns: int) -> dict[tuple[str, Lane], LaneSpan]:
        """Return the span at a time, by car and lane."""
        found = {}
        for place, spans in self.spans.items():
            for span in spans:
                if span.begin_ns <= at_ns <= span.end_ns:
                    found[place] = span  # if two spans touch, the later one counts
        return found

    def _hold(self, car: str, lane: Lane, words: str, at_ns: int, *, bad: bool = False) -> None:
        """Prolong or begin the span that a state means. Empty words end the current span."""
        spans = self._spans(car, lane)
        last = spans[-1] if spans else None
        if last is not None and self._open.get((car, lane)) is last and at_ns - last.end_ns <= HELD_NS:
            last.end_ns = max(last.end_ns, at_ns)
            if last.words == words and last.bad == bad:
                return
        self._open.pop((car, lane), None)
        if words:
            span = LaneSpan(car, lane, at_ns, at_ns, words, bad)
            spans.append(span)
            self._open[car, lane] = span

    def _silence(self, car: str, at_ns: int) -> None:
        """Add a loss for the time in which a car was not heard, once it is heard again."""
        before = self._heard_ns.get(car)
        self._heard_ns[car] = at_ns
        if before is not None and at_ns - before > HELD_NS:
            spans = self._spans(car, Lane.LOSS)
            current = spans.pop() if spans and self._open.get((car, Lane.LOSS)) is spans[-1] else None
            spans.append(LaneSpan(car, Lane.LOSS, before, at_ns, NOT_HEARD, bad=True))
            if current is not None:
                spans.append(current)

    def _stop(self, car: str, event: Any, at_ns: int) -> None:
        stops = self._stops.setdefault(car, {})
        span = stops.get(event.id)
        if span is None:
            span = stops[event.id] = LaneSpan(car, Lane.STOP, at_ns, at_ns, "")
            self._spans(car, Lane.STOP).append(span)
            while len(stops) > MAX_OPEN_STOPS:
                del stops[next(iter(stops))]
        span.end_ns = max(span.end_ns, at_ns)
        span.words = f"{asked_by(event)} {event.phase}{f' ({event.basis})' if event.basis else ''}"
        span.bad = event.phase in _BAD_ENDS
        if event.phase in _LAST_PHASES:
            del stops[event.id]

    def _spans(self, car: str, lane: Lane) -> deque[LaneSpan]:
        return self.spans.setdefault((car, lane), deque(maxlen=MAX_SPANS))


def _kept_by(safety: Any) -> str:
    """Describe what keeps a car from moving: an e-stop, the pause of the fleet, or a hold.

    Empty if nothing does.
    """
    if safety.estops:
        return f"e-stop by {keys.person_of(safety.estops[0].by)}{_because(safety.estops[0].why)}"
    if (pause := binding_pause(safety.pauses)) is not None:
        return f"pause by {keys.person_of(pause.by)}{_because(pause.why)}"
    return f"hold by {keys.person_of(safety.hold.by)}" if safety.HasField("hold") else ""


def _because(why: str) -> str:
    return f": {why}" if why else ""
