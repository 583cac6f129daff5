"""Records a simulated car's truth and the frames that a gateway wrote to the car, with their times.

Times are the publishers' stamps, ns since the epoch. All processes of a test share one clock.
"""

import threading
from dataclasses import dataclass, field
from typing import Any

from schemas.bus import Bus, Sample
from tests.support.processes import wait_for


def stamp_ns(message: Any) -> int:
    """Return the time at which a message was made."""
    return int(message.stamp.seconds * 1_000_000_000 + message.stamp.nanos)


@dataclass
class Judge:
    """The motors of one simulated car and the frames to it. Call `follow` before the first command."""

    car: str
    motors: list[tuple[int, bool]] = field(default_factory=list)
    """Times at which the motors went on or off, the oldest first."""
    moved: list[tuple[int, float, float]] = field(default_factory=list)
    """Time and place, at each change of the place."""
    frames: list[tuple[int, str, bytes]] = field(default_factory=list)
    """Time, origin and bytes of each frame."""
    modes: list[tuple[int, str]] = field(default_factory=list)
    opened: list[int] = field(default_factory=list)
    """Times at which a gateway had opened its link."""
    motors_said: list[tuple[int, str]] = field(default_factory=list)
    """Time and value of each claim about the motors."""
    heard_ns: int = 0
    """Time of the newest truth."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def follow(cls, bus: Bus, car: str = "red") -> "Judge":
        """Subscribe to the truth, the frames, the logs and the claims about the motors of a car."""
        judge = cls(car)
        bus.subscribe(f"fleet/{car}/sim/truth", judge._truth)
        bus.subscribe(f"fleet/{car}/frame/tx", judge._frame)
        bus.subscribe(f"fleet/{car}/event/log", judge._log)
        bus.subscribe(f"fleet/{car}/state/safety", judge._safety)
        return judge

    @property
    def driving(self) -> bool:
        """True if the motors are on by the newest truth."""
        return bool(self.motors) and self.motors[-1][1]

    def wait_off(self, moment_ns: int, *, watched_s: float) -> float:
        """Wait until the motors were off for `watched_s`. Return how long after the moment they went off, s, or 0."""

        def off() -> bool:
            with self._lock:
                if not self.motors or self.motors[-1][1]:
                    return False
                return self.heard_ns >= max(self.motors[-1][0], moment_ns) + watched_s * 1e9

        wait_for(off, f"{self.car} stands")
        with self._lock:
            return max(0.0, (self.motors[-1][0] - moment_ns) / 1e9)

    def on_after(self, moment_ns: int) -> list[float]:
        """Return the times after a moment, s, at which motors went on."""
        with self._lock:
            return [(at - moment_ns) / 1e9 for at, on in self.motors if on and at > moment_ns]

    def written_after(self, moment_ns: int) -> list[tuple[float, bytes]]:
        """Return the frames written after a moment, with their times in s after it."""
        with self._lock:
            return [((at - moment_ns) / 1e9, data) for at, _, data in self.frames if at >= moment_ns]

    def said_after(self, moment_ns: int) -> list[str]:
        """Return the claims about the motors after a moment."""
        with self._lock:
            return [motors for at, motors in self.motors_said if at >= moment_ns]

    def _truth(self, sample: Sample) -> None:
        truth: Any = sample.message()
        at, on = stamp_ns(truth), bool(truth.motor_left or truth.motor_right)
        with self._lock:
            self.heard_ns = at
            if not self.motors or self.motors[-1][1] != on:
                self.motors.append((at, on))
            if not self.modes or self.modes[-1][1] != truth.mode:
                self.modes.append((at, truth.mode))
            if not self.moved or self.moved[-1][1:] != (truth.x_m, truth.y_m):
                self.moved.append((at, truth.x_m, truth.y_m))

    def _frame(self, sample: Sample) -> None:
        frame: Any = sample.message()
        with self._lock:
            self.frames.append((stamp_ns(frame), frame.why, frame.data))

    def _log(self, sample: Sample) -> None:
        event: Any = sample.message()
        if event.name == f"{self.car} link_open":
            with self._lock:
                self.opened.append(event.timestamp.seconds * 1_000_000_000 + event.timestamp.nanos)

    def _safety(self, sample: Sample) -> None:
        safety: Any = sample.message()
        with self._lock:
            self.motors_said.append((stamp_ns(safety), safety.motors))
