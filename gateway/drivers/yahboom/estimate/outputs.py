"""Estimates motion, speed, fan, servo and LED of the car from the written frames.

The car confirms none of them. Its readings are evidence only of its mode (see mode.py).

*Speed.* A car has a speed from its start, and keeps it while the gateway or the link is gone, unless it is switched off
meanwhile. So the estimate is a set of speeds that the car may have, one set for each kind of program, because the
platform may be detected again. `speed_max` is compared with the highest of them, and while the platform is unknown,
with the highest for any platform. A step changes each of them, and several may become one again.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from msgspec.structs import replace

from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, General, ModeClose, ModeOpen, Ptz
from gateway.drivers.yahboom.protocol.platforms import FRONT_SERVO, SPEEDS, Profile, SpeedModel
from schemas.words import Mode, Motion, Platform, SpeedStep

# The car looks around in avoidance, and sweeps in color LED mode. In remote control, a person may turn the servo.
_TURN_SERVO = frozenset({Mode.REMOTE_CONTROL, Mode.OBSTACLE_AVOIDANCE, Mode.COLOR_LED})

Speeds = dict[Platform, frozenset[float]]
"""For each platform, the speeds that a car with such a program may have, in its own unit."""


def speeds_at_start() -> Speeds:
    """Return the speeds of a car that was just switched on."""
    return {kind: frozenset({model.start}) for kind, model in SPEEDS.items()}


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
    """The last number sent to the front servo, or None if the servo may have turned to another angle since then."""
    led: ColorLed = field(default_factory=lambda: ColorLed(0, 0, 0))
    speeds: Speeds = field(default_factory=speeds_at_start)

    @property
    def share(self) -> float:
        """Return the highest speed that the car may have, as a share of full speed."""
        return share_of(self.speeds, self.profile.kind)

    def allow_restart(self) -> None:
        """Allow for a car that was switched off and on, and has the speed and the servo angle of its start now."""
        self.servo_deg = None
        self.speeds = {kind: speeds | {SPEEDS[kind].start} for kind, speeds in self.speeds.items()}

    def allow(self, speeds: Speeds) -> None:
        """Allow for a car that has one of these speeds."""
        self.speeds = joined(self.speeds, speeds)

    def on_written(self, frame: Frame, now: float) -> None:
        """Apply a written frame."""
        match frame:
            case General():
                if frame.motion is not Motion.STOP:
                    self.repeat = self.repeat or frame.motion is not self.motion
                self.motion = frame.motion
                if frame.servo in FRONT_SERVO:
                    self.servo_deg = None
                if frame.speed is not None:
                    self.speeds = stepped(self.speeds, frame.speed)
                if self.profile.fan_is_level:
                    self.fan_at = now if frame.fan is not self.fan else self.fan_at
                    self.fan = frame.fan
                elif frame.fan:
                    self.fan = None if self.fan is None else not self.fan
                    self.fan_at = now
                    self.fan_toggled = True
            case ModeClose():
                self.motion = Motion.STOP
            case ModeOpen(mode):
                self.speeds = {kind: _after_mode(SPEEDS[kind], at, mode) for kind, at in self.speeds.items()}
                if mode in _TURN_SERVO:
                    self.servo_deg = None
            case Ptz(deg):
                self.servo_deg = deg
            case ColorLed():
                self.led = frame
            case _:
                pass

    def steps_to(self, share: float) -> list[SpeedStep] | None:
        """Return the steps after which the car drives with at most this share of full speed, or None if none do so.

        Mostly these are steps down. But if the car may have one of several speeds, steps down may never make all of
        them slow enough, because a step below the slowest speed makes some cars faster. At the top they become one.
        """
        speeds, to_top = self.speeds, 0
        while (down := self._steps_down(speeds, share)) is None:
            faster = stepped(speeds, SpeedStep.UP)
            if faster == speeds:
                return None
            speeds, to_top = faster, to_top + 1
        return [SpeedStep.UP] * to_top + [SpeedStep.DOWN] * down

    def _steps_down(self, speeds: Speeds, share: float) -> int | None:
        seen: list[Speeds] = []
        while share_of(speeds, self.profile.kind) > share:
            if speeds in seen:
                return None
            seen.append(speeds)
            speeds = stepped(speeds, SpeedStep.DOWN)
        return len(seen)

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


def stepped(speeds: Speeds, step: SpeedStep) -> Speeds:
    """Return the speeds that one step gives a car which has one of these speeds."""
    return {kind: frozenset(SPEEDS[kind].step(speed, step) for speed in each) for kind, each in speeds.items()}


def joined(one: Speeds, other: Speeds) -> Speeds:
    """Return the speeds of a car which has a speed of either."""
    return {kind: each | other[kind] for kind, each in one.items()}


def share_of(speeds: Speeds, kind: Platform) -> float:
    """Return the highest of these speeds as a share of full speed: of this platform, or of any if it is unknown."""
    return max(SPEEDS[each].fraction(max(speeds[each])) for each in ((kind,) if kind in SPEEDS else SPEEDS))


def _after_mode(model: SpeedModel, speeds: frozenset[float], mode: Mode) -> frozenset[float]:
    """Return the speeds that a car may have after this mode: any speed, if the mode sets it."""
    return frozenset(map(float, range(int(model.top) + 1))) if mode in model.set_by else speeds


def kept_speeds(speeds: Speeds) -> dict[str, list[float]]:
    """Return the speeds as JSON values, without those of a car that was just switched on."""
    return {str(kind): sorted(each) for kind, each in speeds.items() if each != {SPEEDS[kind].start}}


def restored_speeds(kept: Mapping[str, Iterable[float]]) -> Speeds:
    """Return the speeds from the result of `kept_speeds`. Raises ValueError or TypeError if that is damaged."""
    speeds = speeds_at_start()
    for kind, each in kept.items():
        values, model = frozenset(map(float, each)), SPEEDS[Platform(kind)]
        if not values or not all(0.0 <= value <= model.top for value in values):  # also refuses NaN
            raise ValueError(f"speeds of {kind}: {values}")
        speeds[Platform(kind)] = values
    return speeds
