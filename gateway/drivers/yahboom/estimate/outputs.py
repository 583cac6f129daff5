"""Estimates motion, speed, fan, servo and LED of the car from the written frames.

The car confirms none of them. Its readings are evidence only of its mode (see mode.py).
"""

from dataclasses import dataclass, field

from msgspec.structs import replace

from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, General, ModeClose, ModeOpen, Ptz
from gateway.drivers.yahboom.protocol.platforms import Profile
from schemas.words import Motion, SpeedStep


@dataclass(slots=True)
class StateEstimate:
    """The effect of all frames written since the gateway began (fan: since the link opened). Times: s, monotonic."""

    profile: Profile
    motion: Motion = Motion.STOP
    """The last motion sent."""
    repeat: bool = False
    """True if the motion has changed, and has not been repeated yet (docs/reference/protocol.md#pacing: the 1.1 s
    rule)."""
    fan: bool | None = None
    fan_at: float = float("-inf")
    """When the fan was last toggled."""
    fan_toggled: bool = False
    """True if the fan was toggled, and no reading has arrived since it reached its new state."""
    servo_deg: int | None = None
    led: ColorLed = field(default_factory=lambda: ColorLed(0, 0, 0))
    speed: float = field(init=False)
    """In the unit of the car (see `SpeedModel`)."""
    speed_is_bound: bool = False
    """True if the car may be slower than `speed`, because a mode has set its speed."""

    def __post_init__(self) -> None:
        self.speed = self.profile.speed.start

    def on_written(self, frame: Frame, now: float) -> None:
        """Apply a written frame."""
        match frame:
            case General():
                if frame.motion is not Motion.STOP:
                    self.repeat = self.repeat or frame.motion is not self.motion
                self.motion = frame.motion
                if frame.speed is not None:
                    self._step(frame.speed)
                if self.profile.fan_is_level:
                    self.fan_at = now if frame.fan is not self.fan else self.fan_at
                    self.fan = frame.fan
                elif frame.fan:
                    self.fan = None if self.fan is None else not self.fan
                    self.fan_at = now
                    self.fan_toggled = True
            case ModeClose():
                self.motion = Motion.STOP
            case ModeOpen(mode) if mode in self.profile.speed.set_by:
                self.speed, self.speed_is_bound = self.profile.speed.top, True
            case Ptz(deg):
                self.servo_deg = deg
            case ColorLed():
                self.led = frame
            case _:
                pass

    def _step(self, step: SpeedStep) -> None:
        self.speed = max(self.profile.speed.step(self.speed, step), self.slowest if self.speed_is_bound else 0.0)

    @property
    def slowest(self) -> float:
        """Return the lowest value that steps down give `speed`.

        If the speed is not known, a step down may have led to `rebound`, and the next one below it, and so on.
        """
        return self.profile.speed.rebound if self.speed_is_bound else self.profile.speed.low

    @property
    def fan_may_run(self) -> bool:
        """Return True if the fan runs, or may run: its state is unknown, and it was toggled since the last reading."""
        return self.fan is True or (self.fan is None and self.fan_toggled)

    def with_motion(self, frame: Frame) -> Frame:
        """Return the frame with the current motion, which every general frame carries."""
        return replace(frame, motion=self.motion) if isinstance(frame, General) else frame

    def with_fan(self, frame: Frame) -> Frame:
        """Return the frame with the level of the fan, which every general frame of some cars carries."""
        if not isinstance(frame, General) or not self.profile.fan_is_level:
            return frame
        return replace(frame, fan=bool(self.fan))
