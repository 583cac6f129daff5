"""A family of cars from another package: a tank that takes JSON lines over TCP.

A line `{"move":[0.5,0.5]}` sets the share of full power of each side, until the next one. The tank sends
`{"v":7.9,"dist_cm":42}` five times a second. It has no dead-man, acknowledges nothing, and ignores lines that it cannot
read.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, ClassVar

from gateway.control.commands import Action
from gateway.control.driver import Desk, Event, Fields, Rejected, TextLine
from gateway.drivers.lines import LineSplitter
from gateway.drivers.plain import PlainDriver
from gateway.drivers.plain_profile import PlainProfile
from schemas.words import Cause, Motion

PLATFORMS = ("tank",)
SAMPLES = (b'{"v":7.9,"dist_cm":42}\n',)

PROFILE = PlainProfile("tank", frozenset({"drive", "speed"}), frozenset({"battery", "range"}))
SIDES = {
    Motion.STOP: (0, 0),
    Motion.FORWARD: (1, 1),
    Motion.BACK: (-1, -1),
    Motion.LEFT: (0.4, 1),
    Motion.RIGHT: (1, 0.4),
    Motion.SPIN_LEFT: (-1, 1),
    Motion.SPIN_RIGHT: (1, -1),
}


class TankReport:
    """One report of the tank."""

    def __init__(self, raw: bytes, at: float, volts: float, dist_cm: float) -> None:
        self.raw, self.at, self.volts, self.dist_cm = raw, at, volts, dist_cm


class TankDriver(PlainDriver):
    """One tank."""

    STOP_FRAMES: ClassVar[int] = 2
    STOPS_WITHIN_S: ClassVar[float] = 0.3
    SILENCE_S: ClassVar[float | None] = 2.0

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk, PROFILE)
        self._lines = LineSplitter()

    def link_up(self, now: float) -> None:
        """Forget the unfinished line of the last link."""
        self._lines = LineSplitter()
        super().link_up(now)

    def feed(self, data: bytes, now: float) -> list[Event]:
        """Return the events in the bytes."""
        return [self._event(each, now) for each in self._lines.feed(data)]

    def _event(self, line: bytes, now: float) -> Event:
        if not line.startswith(b"{"):
            return TextLine(line, now)
        try:
            found = json.loads(line)
            return TankReport(line, now, float(found["v"]), float(found["dist_cm"]))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            return Rejected(line, now, Cause.TRUNCATED)

    def drop_bytes(self) -> list[Event]:
        """Forget the unfinished line."""
        self._lines.take_rest()
        return []

    def measured(self, event: Event) -> Mapping[str, Fields]:
        """Return the measured values by topic."""
        if not isinstance(event, TankReport):
            return {}
        topics: dict[str, Fields] = {}
        if 0 < event.volts < 9:
            topics["sensor/battery"] = {"voltage_v": event.volts}
        if 0 < event.dist_cm < 400:
            topics["sensor/range"] = {"range_m": event.dist_cm / 100}
        return topics

    def on_reading(self, event: Event, now: float) -> None:
        """Take a report."""
        if isinstance(event, TankReport) and 0 < event.volts < 9:
            self.on_voltage(event.volts, now)
        if isinstance(event, TankReport) and 0 < event.dist_cm < 400:
            self.model.range_cm, self.model.range_at = event.dist_cm, event.at

    def motion_frame(self, motion: Motion) -> bytes:
        """Return the line of a motion."""
        sides = [round(self.model.speed * share, 2) for share in SIDES[motion]]
        return json.dumps({"move": sides}).encode() + b"\n"

    def stop_frame(self, index: int) -> bytes:
        """Return a stop. `#` makes the half line invalid that a failed write may have left in the tank's buffer."""
        del index
        return b"#\n" + self.motion_frame(Motion.STOP)

    def part_frames(self, what: Action) -> tuple[bytes, ...] | None:
        """Return None: a tank has no lights, no servos."""
        del what
        return None


def wheels_after(data: bytes) -> tuple[float, float] | None:
    """Return what a tank does with these bytes: the shares of full speed of its left and right side. For the check."""
    wheels = None
    for line in data.split(b"\n")[:-1]:
        with suppress(ValueError, KeyError):  # a tank ignores such a line
            left, right = json.loads(line)["move"]
            wheels = (left, right)
    return wheels


def profile_of(name: str) -> PlainProfile:
    """Return what a tank can do. Raises ValueError for a wrong name."""
    if name != "tank":
        raise ValueError(f'There is no platform "{name}" here. There is: tank.')
    return PROFILE


def profiles() -> tuple[PlainProfile, ...]:
    """Return the profile of each platform."""
    return (PROFILE,)


def driver_of(name: str, kept: Mapping[str, Any]) -> Callable[[Desk], TankDriver]:
    """Return the driver of a tank."""
    profile_of(name)
    del kept
    return TankDriver
