"""The status of one car from its messages, and the changes that are reported in a line. Pure: time is an argument."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC
from typing import Any, Final

from msgspec import Struct

from fleet.client.car_state import CarState
from fleet.client.claims import CarClaim, motors_claim
from schemas.keys import name_of
from schemas.local_time import date_and_clock
from schemas.words import LinkState

MAX_CARS_LISTED: Final = 8
"""Maximum number of cars that one line lists."""
READY_TIMEOUT_S: Final = 30.0
"""A start ends when no further car has become ready for this time, even if some are missing."""
LINK_OPEN_TIMEOUT_S: Final = 10.0
"""The timeout in place of READY_TIMEOUT_S if all that is missing is cars whose links cannot be opened."""
REACHED_S: Final = 2.0
"""Time for which a link must be open to count as a link to a car, if the car sends nothing."""
RATE_WINDOW_S: Final = 2.0
"""Minimum time over which the frame rate is measured."""


@dataclass(slots=True)
class CarStatus:
    """The state of one car for the supervisor, and which of its changes are reported in a line."""

    car: str
    state: CarState = field(init=False)
    rate_hz: float | None = None
    """Frames per second from the car."""
    event: str = ""
    safety_received: bool = False
    """True if any gateway has published the car's state/safety."""
    reached: bool = False
    """True if any gateway has had an open link to the car: bytes came, or the link stayed open."""
    _counted: tuple[float, int] | None = None
    _reported: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.state = CarState(self.car, present=False)

    @property
    def motors(self) -> CarClaim:
        """The last claim about the motors, also of a gateway that has ended since."""
        return motors_claim(self.state.newest("state/safety"))

    def take(self, topic: str, value: Any, now: float) -> str:
        """Update from a message. Return a line for a notable change, else an empty string."""
        if topic == "event/log":
            self.event = value.message.removeprefix(f"{self.car} ")
        if topic.startswith("event/") or not self.state.take(topic, value, now):
            return ""
        # The supervisor knows when a gateway has ended (`reset`). Until then, a gateway that publishes a state is
        # present.
        self.state.present |= topic.startswith("state/")
        match topic:
            case "state/link":
                # A bridge that is in use accepts a connection, and closes it before it sends a byte.
                self.reached |= value.state in _OPEN and (value.rx_bytes > 0 or value.since_s >= REACHED_S)
                self._count(value.rx_frames, now)
                return self._change("link", f"link {value.state}{f': {value.reason}' if value.reason else ''}")
            case "state/mode":
                return self._change("mode", f"mode {value.asked}, {value.verdict}")
            case "state/motion":
                by = f" by {name_of(value.owner)}" if value.owner else ""
                return self._change("motion", f"motion {value.motion}{by}")
            case "state/safety" if value.estops:
                return self._change("safety", f"e-stop {' '.join(each.id for each in value.estops)}")
            case "state/safety":
                held = f"on hold by {name_of(value.hold.by)}" if value.HasField("hold") else "not on hold"
                return self._change("safety", held)
            case "sensor/battery":
                return self._change("battery", f"battery {value.level}")
            case _:
                return ""

    def reset(self, running: str = "") -> None:
        """Note that the car's gateway has ended. `running` is the boot_id of the next one, if it is known."""
        self.state.on_gateway_end(running)
        self.rate_hz = self._counted = None
        self._reported.clear()

    def _count(self, frames: int, now: float) -> None:
        if self._counted is None or frames < self._counted[1]:
            self._counted = (now, frames)
        elif now - self._counted[0] >= RATE_WINDOW_S:
            self.rate_hz = (frames - self._counted[1]) / (now - self._counted[0])
            self._counted = (now, frames)

    def _change(self, what: str, words: str) -> str:
        """Return the words if they are new. A growing time is not new, nor is a normal value in the first message."""
        essence = _SECONDS.sub("", words)
        before, self._reported[what] = self._reported.get(what), essence
        return "" if essence == before or (before is None and words in _AT_FIRST) else words


class StartProgress(Struct):
    """The progress of a start: the smallest number of missing cars and services so far, and when it was reached."""

    fewest: int | None = None
    since: float = 0.0

    def has_ended(self, missing: int, now: float, *, unreachable: bool) -> bool:
        """Return True if no car or service is missing, or if none has become ready for a while.

        `unreachable` is True if all that is missing is cars whose links cannot be opened.
        """
        if self.fewest is None or missing < self.fewest:
            self.fewest, self.since = missing, now
        return not missing or now - self.since >= (LINK_OPEN_TIMEOUT_S if unreachable else READY_TIMEOUT_S)


def describe_start(cars: Sequence[str], missing: Mapping[str, str], session: str, console: str = "") -> str:
    """Describe the end of a start in one line: all cars are ready, or who is missing and why."""
    ready = [car for car in cars if car not in missing]
    if missing:
        first = [f"{name.lstrip('@')} ({why.rstrip('.')})" for name, why in list(missing.items())[:MAX_CARS_LISTED]]
        more = f" and {len(missing) - MAX_CARS_LISTED} more" if len(missing) > MAX_CARS_LISTED else ""
        words = f"{len(ready)} of {len(cars)} cars ready. Missing: {', '.join(first)}{more}."
    elif len(cars) == 1:
        words = f"{cars[0]} is ready."
    else:
        names = f": {', '.join(cars)}" if len(cars) <= MAX_CARS_LISTED else ""
        words = f"All {len(cars)} cars are ready{names}."
    words = f"{words} Recording to {session}." if session else words
    return f"{words} Console: {console}" if console else words


def describe_old_stops(car: str, safety: Any, began_s: float) -> str:
    """Describe a hold and e-stops older than `began_s` (s since the epoch). Return an empty string if there are none.

    `safety` is a fleet.v1.Safety.
    """
    estops = [each for each in safety.estops if each.stamp.ToDatetime(UTC).timestamp() < began_s]
    held = safety.HasField("hold") and safety.hold.since.ToDatetime(UTC).timestamp() < began_s
    resume = f"fleet resume {car}"
    words = []
    if estops:
        first = estops[0]
        why = f" ({first.why})" if first.why else ""
        more = f" and {len(estops) - 1} more" if len(estops) > 1 else ""
        words.append(
            f"e-stopped by {name_of(first.by)}{why} since {_date(first.stamp)}{more}: {car} only accepts stops"
        )
    if held:
        words.append(f"on hold by {name_of(safety.hold.by)} since {_date(safety.hold.since)}: no plan moves {car}")
    if not words:
        return ""
    ends = " and then ".join([f"`{resume} --estops`"] * bool(estops) + [f"`{resume}`"] * held)
    return f"{'; '.join(words)}. To end that: {ends}"


def _date(stamp: Any) -> str:
    return date_and_clock(stamp.seconds)


_SECONDS: Final = re.compile(r"[\d.]+ s\b")
_OPEN: Final = frozenset(LinkState) - {LinkState.LOST}
_AT_FIRST: Final = frozenset({"not on hold", "battery ok", "motion stop", "motion unknown"})
