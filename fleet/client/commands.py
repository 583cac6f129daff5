"""Commands as values, and the methods that make them: the same names for the sync and the async client. Pure.

Whether a car may or can carry a command out is its gateway's to judge; here only what no gateway could take is refused.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from fleet.client.outcome import Until
from schemas.gen import fleet_v1_pb2 as pb

R = TypeVar("R")

LONGEST_DRIVE_S: Final = 3600.0
"""No gateway allows more; each allows 10 s unless it was started with a longer `--longest-drive`."""

STOP_TTL_S: Final = 10.0
"""How old a stop may be when it arrives: a drive that was held up is refused after 0.5 s, its end is wanted still."""


@dataclass(frozen=True, slots=True)
class CommandRequest:
    """One command before it has a sender, an id and a time."""

    verb: str
    message: Any
    """Its payload, a `fleet.v1.<Verb>Command`; Any: the generated classes share no type with these fields."""
    until: Until = Until.SENT
    lasts_s: float = 0.0
    """How long a drive holds, s."""
    take: bool = False
    """As a person, also if another person drives the car."""


def drive_request(motion: str, duration_s: float = 0.5, *, wait: bool = True) -> CommandRequest:
    """Hold a motion for `duration_s` (at most 10 s, or what its gateway allows); `wait`: until the drive is over."""
    if not (math.isfinite(duration_s) and 0 < duration_s <= LONGEST_DRIVE_S):
        raise ValueError(
            f"duration {duration_s:g} s is not allowed: more than 0 and at most {LONGEST_DRIVE_S:g} s; "
            "to go on, drive again"
        )
    message = pb.DriveCommand(motion=motion, duration_s=duration_s)
    if motion == "stop":
        message.ttl_s = STOP_TTL_S
        return CommandRequest("drive", message, Until.STOPPED)
    return CommandRequest("drive", message, Until.OVER if wait else Until.SENT, duration_s)


def mode_request(mode: str) -> CommandRequest:
    """Bring the car into a mode."""
    return CommandRequest("mode", pb.ModeCommand(mode=mode))


def led_request(r: int, g: int, b: int) -> CommandRequest:
    """The colour LED, 0..255 each."""
    for name, value in (("r", r), ("g", g), ("b", b)):
        _whole(name, value, 255)
    return CommandRequest("led", pb.LedCommand(r=r, g=g, b=b))


def servo_request(servo: str, action: str = "", deg: int | None = None) -> CommandRequest:
    """Move a servo by an action, or the front one to `deg` (0..180)."""
    message = pb.ServoCommand(servo=servo, action=action)
    if deg is not None:
        _whole("deg", deg, 180)
        message.deg = deg
    return CommandRequest("servo", message)


def arm_request(joint_deg: Sequence[int]) -> CommandRequest:
    """Six joints, 0..180 degrees each."""
    if len(joint_deg) != 6:
        raise ValueError(f"an arm has six joints, {len(joint_deg)} given")
    for number, value in enumerate(joint_deg, start=1):
        _whole(f"joint {number}", value, 180)
    return CommandRequest("arm", pb.ArmCommand(joint_deg=joint_deg))


def light_request(light: str) -> CommandRequest:
    """The light's colour, or off."""
    return CommandRequest("light", pb.LightCommand(light=light))


def whistle_request() -> CommandRequest:
    """Sound once."""
    return CommandRequest("whistle", pb.WhistleCommand())


def speed_request(step: str) -> CommandRequest:
    """One step up or down."""
    return CommandRequest("speed", pb.SpeedCommand(step=step))


def fan_request(state: str | None = None) -> CommandRequest:
    """Toggle the fan, or bring it to a state."""
    return CommandRequest("fan", pb.FanCommand(state=state or ""))


def lease_request(*, take: bool = False, release: bool = False) -> CommandRequest:
    """Have the car for 2 s, or give it back; `take`: as a person, also from another person."""
    return CommandRequest("lease", pb.LeaseCommand(release=release), take=take)


def find_request() -> CommandRequest:
    """Blink and beep."""
    return CommandRequest("find", pb.FindCommand())


def stop_request() -> CommandRequest:
    """Stop, and hold against the coordinator."""
    return CommandRequest("stop", pb.StopCommand(), Until.STOPPED)


def estop_request(why: str, scope: str) -> CommandRequest:
    """Emergency stop; `scope` is car or fleet."""
    return CommandRequest("estop", pb.EstopCommand(why=why, scope=scope), Until.STOPPED)


def resume_request(ids: Sequence[str] = ()) -> CommandRequest:
    """End the e-stops of these ids; without ids, the hold."""
    return CommandRequest("resume", pb.ResumeCommand(ids=ids))


def _whole(name: str, value: int, top: int) -> None:
    if not 0 <= value <= top:
        raise ValueError(f"{name} {value!r} is not allowed: a whole number, 0 to {top}")


class CarCommands(ABC, Generic[R]):
    """The commands of one car. R is `Outcome`, or an awaitable of it.

    Each waits until the car's gateway says what became of the command (a stop: until it is complete); none raises
    because of a car: `Outcome.ok` says whether it was carried out. A value out of range raises ValueError.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def do(self, request: CommandRequest) -> R:
        """Ask for one command; the methods below make the requests."""

    def drive(self, motion: str, duration_s: float = 0.5, *, wait: bool = True) -> R:
        """Hold `forward, back, left, right, spin_left, spin_right` for `duration_s`; `stop` ends the motion.

        More than 0 s and at most 10, unless the gateway was started with a longer `--longest-drive`; then the gateway
        stops the car. Returns when the drive is over; with `wait=False` when the motion was sent, so that another can
        follow: a drive replaces the one before without a stop between them.
        """
        return self.do(drive_request(motion, duration_s, wait=wait))

    def mode(self, mode: str) -> R:
        """`manual, remote_control, tracking, obstacle_avoidance, color_led, light_seeking` or `following`."""
        return self.do(mode_request(mode))

    def led(self, r: int, g: int, b: int) -> R:
        """The colour LED, 0..255 each."""
        return self.do(led_request(r, g, b))

    def light(self, light: str) -> R:
        """`white, red, green, blue, cyan, magenta, yellow` or `off`."""
        return self.do(light_request(light))

    def servo(self, servo: str, action: str = "", deg: int | None = None) -> R:
        """`front`, `horizontal`: left, right, reset; `vertical`: up, down, reset; `front` instead to `deg` (0..180)."""
        return self.do(servo_request(servo, action, deg))

    def arm(self, joint_deg: Sequence[int]) -> R:
        """Six joints, 0..180 degrees each."""
        return self.do(arm_request(joint_deg))

    def whistle(self) -> R:
        """Sound once."""
        return self.do(whistle_request())

    def speed(self, step: str) -> R:
        """One step `up` or `down`: the car knows no absolute speed."""
        return self.do(speed_request(step))

    def fan(self, state: str | None = None) -> R:
        """Toggle the fan; `on` or `off` only while the gateway knows its state."""
        return self.do(fan_request(state))

    def stop(self) -> R:
        """Stop, and hold against the coordinator; waits until the stop is complete."""
        return self.do(stop_request())

    def estop(self, why: str = "") -> R:
        """Emergency stop of this car."""
        return self.do(estop_request(why, "car"))

    def resume(self, ids: Sequence[str] = ()) -> R:
        """End the e-stops of these ids; without ids, the hold."""
        return self.do(resume_request(ids))

    def find(self) -> R:
        """Blink and beep, without moving."""
        return self.do(find_request())
