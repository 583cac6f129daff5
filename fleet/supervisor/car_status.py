"""The status of one car from its messages, and the changes that are reported in a line. Pure: time is an argument."""

import re
from dataclasses import dataclass, field
from typing import Any, Final

from fleet.client.car_state import CarState
from fleet.client.claims import CarClaim, motors_claim
from schemas.keys import name_of
from schemas.words import LinkState

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
                # A bridge that is in use accepts a connection, and soon closes it, often before it sends a byte.
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


_SECONDS: Final = re.compile(r"[\d.]+ s\b")
_OPEN: Final = frozenset(LinkState) - {LinkState.LOST}
_AT_FIRST: Final = frozenset({"not on hold", "battery ok", "motion stop", "motion unknown"})
