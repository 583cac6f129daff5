"""Command requests, and the methods that make them for the blocking and the asyncio client. Pure.

Each gateway decides whether its car may and can carry out a command. Here, only values that no gateway accepts are
rejected.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Final, Generic, TypeVar

from msgspec import Struct

from fleet.client.outcome import Until
from fleet.client.outcome_words import ESTOP_FLEET, RELEASE
from schemas import keys, messages
from schemas.commands import COMMANDS, Verb
from schemas.gen import fleet_v1_pb2 as pb
from schemas.limits import MAX_REASON_LENGTH
from schemas.process.stdio import printable
from schemas.words import Motion, Scope

R = TypeVar("R")

MAX_DRIVE_S: Final = 3600.0
"""Maximum duration of a drive. A gateway allows 10 s unless it was started with another `--longest-drive`."""

STOP_TTL_S: Final = 10.0
"""Maximum age of a stop when it arrives. A drive is rejected if it is delayed by 0.5 s, but a delayed stop is still
useful."""


class CommandRequest(Struct, frozen=True):
    """One command that has no id and no time yet."""

    verb: str
    message: Any
    """The payload, a `fleet.v1.<Verb>Command`. Any, because the generated classes have no common type."""
    until: Until = Until.SENT
    duration_s: float = 0.0
    """Duration of a drive, s."""
    take: bool = False
    """True if a person takes the car over from another person."""
    sender: str = ""
    """The sender of the command. If it is empty, the client is the sender."""

    @property
    def effect_verb(self) -> str:
        """The verb for `outcome_words`. An e-stop of all cars has other texts there, and so has a drive that stops."""
        if self.verb == Verb.ESTOP and self.message.scope == Scope.FLEET:
            return ESTOP_FLEET
        return RELEASE if self.verb == Verb.DRIVE and self.until is Until.STOPPED else self.verb

    @property
    def detail(self) -> str:
        """The part of the request that the text of its outcome repeats."""
        match self.verb:
            case Verb.DRIVE:
                return f"{self.duration_s:.1f} s" if self.duration_s >= 1 else f"{self.duration_s:g} s"
            case Verb.MODE | Verb.LIGHT:
                return str(getattr(self.message, self.verb))
            case Verb.SPEED:
                return str(self.message.step)
            case Verb.FAN:
                return self.message.state or "toggle"
            case _:
                return ""


def drive_request(motion: str, duration_s: float = 0.5, *, wait: bool = True) -> CommandRequest:
    """Request a motion for `duration_s` (at most 10 s, or the gateway's limit). With `wait`, wait until it ends."""
    if not hasattr(duration_s, "__float__"):  # text, from a caller without a type checker
        raise TypeError(f"duration {duration_s!r} is not allowed: write a number of seconds, such as 1.5")
    try:
        duration_s = float(duration_s)  # a Decimal or a Fraction fails in arithmetic with floats
    except OverflowError:
        duration_s = math.inf
    if not 0 < duration_s <= MAX_DRIVE_S:  # this also rejects NaN
        raise ValueError(
            f"duration {duration_s:g} s is not allowed: more than 0 and at most {MAX_DRIVE_S:g} s; "
            "for a longer drive, send the motion again"
        )
    message = pb.DriveCommand(motion=motion, duration_s=duration_s)
    if motion == Motion.STOP:
        message.ttl_s = STOP_TTL_S
        return CommandRequest(Verb.DRIVE, message, Until.STOPPED)
    return CommandRequest(Verb.DRIVE, message, Until.OVER if wait else Until.SENT, duration_s)


def mode_request(mode: str) -> CommandRequest:
    """Request a mode."""
    return CommandRequest(Verb.MODE, pb.ModeCommand(mode=mode))


def led_request(r: int, g: int, b: int) -> CommandRequest:
    """Request a color of the LED, 0..255 each."""
    for name, value in (("r", r), ("g", g), ("b", b)):
        _check_range(name, value, 255)
    return CommandRequest(Verb.LED, pb.LedCommand(r=r, g=g, b=b))


def servo_request(servo: str, action: str = "", deg: int | None = None) -> CommandRequest:
    """Request an action of a servo, or an angle (0..180) of the front one."""
    message = pb.ServoCommand(servo=servo, action=action)
    if deg is not None:
        _check_range("deg", deg, 180)
        message.deg = deg
    return CommandRequest(Verb.SERVO, message)


def arm_request(joint_deg: Sequence[int]) -> CommandRequest:
    """Request angles of the arm's six joints, 0..180 degrees each."""
    if len(joint_deg) != 6:
        raise ValueError(f"an arm has six joints, {len(joint_deg)} given")
    for number, value in enumerate(joint_deg, start=1):
        _check_range(f"joint {number}", value, 180)
    return CommandRequest(Verb.ARM, pb.ArmCommand(joint_deg=joint_deg))


def light_request(light: str) -> CommandRequest:
    """Request a color of the light, or off."""
    return CommandRequest(Verb.LIGHT, pb.LightCommand(light=light))


def plain_request(verb: str, **fields: Any) -> CommandRequest:
    """Request a command of `schemas.commands` whose fields need no check here. `fields` are those of its message."""
    return CommandRequest(verb, messages.message_class(COMMANDS[verb].message)(**fields))


def speed_request(step: str) -> CommandRequest:
    """Request one speed step up or down."""
    return CommandRequest(Verb.SPEED, pb.SpeedCommand(step=step))


def fan_request(state: str | None = None) -> CommandRequest:
    """Request a toggle of the fan, or a state."""
    return CommandRequest(Verb.FAN, pb.FanCommand(state=state or ""))


def lease_request(*, take: bool = False, release: bool = False) -> CommandRequest:
    """Request a lease for 2 s, or its release. With `take`, a person takes the car over from another person."""
    return CommandRequest(Verb.LEASE, pb.LeaseCommand(release=release), take=take)


def stop_request() -> CommandRequest:
    """Request a stop and a hold.

    No plan moves the car until a person or script drives it, gives it a mode, or resumes it.
    """
    return CommandRequest(Verb.STOP, pb.StopCommand(), Until.STOPPED)


def estop_request(why: str, scope: str) -> CommandRequest:
    """Request an e-stop. `scope` is car or fleet."""
    return CommandRequest(Verb.ESTOP, pb.EstopCommand(why=_reason(why), scope=scope), Until.STOPPED)


def resume_request(ids: Sequence[str] = (), *, everything: bool = False) -> CommandRequest:
    """Request the end of the e-stops with these ids; a str is one id.

    Without ids, request the end of the hold that a stop left. With `everything`, request the end of the hold and of all
    e-stops.
    """
    ids = [ids] if isinstance(ids, str) else ids  # otherwise each letter would be an id
    return CommandRequest(Verb.RESUME, pb.ResumeCommand(ids=ids, all=everything))


def pause_request(why: str = "") -> CommandRequest:
    """Request a stop, and a pause of the whole fleet."""
    return CommandRequest(Verb.PAUSE, pb.PauseCommand(why=_reason(why)), Until.STOPPED)


def lend_request(to: str, duration_s: float) -> CommandRequest:
    """Request a loan of the car for `duration_s`: only that person, their scripts, and leads may drive it."""
    return CommandRequest(Verb.LEND, pb.LendCommand(to=keys.check_name(to, "person"), duration_s=duration_s))


def end_loan_request() -> CommandRequest:
    """Request the end of a loan."""
    return CommandRequest(Verb.LEND, pb.LendCommand(end=True))


def _reason(why: object) -> str:
    """Return what a gateway stores of a reason. A reason that no message can carry must not make an e-stop fail."""
    return printable(str(why or "")[:MAX_REASON_LENGTH], " ")


def _check_range(name: str, value: int, top: int) -> None:
    if not 0 <= value <= top:
        raise ValueError(f"{name} {value!r} is not allowed: a whole number, 0 to {top}")


class CarCommands(ABC, Generic[R]):
    """The commands of one car. R is `Outcome` or an awaitable of it.

    Each command waits for its outcome (a stop waits until it is complete). `Outcome.ok` is True if the command was
    carried out. Commands raise ValueError for a value out of range, but never because of a car, except within a lease.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def do(self, request: CommandRequest) -> R:
        """Send one command. The methods below make the requests."""

    def drive(self, motion: str, duration_s: float = 0.5, *, wait: bool = True) -> R:
        """Drive `forward, back, left, right, spin_left, spin_right` for `duration_s`, or end the motion with `stop`.

        The duration is more than 0 s and at most 10 s, unless the gateway was started with another `--longest-drive`.
        At the end of the drive, the gateway stops the car, and the call returns. With `wait=False`, the call returns
        when the motion was sent. A further drive replaces the running one without a stop in between.
        """
        return self.do(drive_request(motion, duration_s, wait=wait))

    def mode(self, mode: str) -> R:
        """Put the car into a mode (`schemas.words.Mode`): `manual` to drive it, or another such as `tracking`."""
        return self.do(mode_request(mode))

    def led(self, r: int, g: int, b: int) -> R:
        """Set the color LED: red, green and blue, 0..255 each."""
        return self.do(led_request(r, g, b))

    def light(self, light: str) -> R:
        """Set the light: `white, red, green, blue, cyan, magenta, yellow` or `off`."""
        return self.do(light_request(light))

    def servo(self, servo: str, action: str = "", deg: int | None = None) -> R:
        """Turn a servo: the front servo to its end, a camera's servo by one step, any servo to its middle (`reset`).

        `servo` is `front` or `horizontal`, with the actions left, right and reset; or `vertical`, with up, down and
        reset. Instead of an action, `front` accepts an angle: `deg`, 0..180.
        """
        return self.do(servo_request(servo, action, deg))

    def arm(self, joint_deg: Sequence[int]) -> R:
        """Move the arm's six joints, 0..180 degrees each."""
        return self.do(arm_request(joint_deg))

    def whistle(self) -> R:
        """Sound the whistle once."""
        return self.do(plain_request(Verb.WHISTLE))

    def speed(self, step: str) -> R:
        """Change the speed by one step, `up` or `down`. Cars accept no absolute speed."""
        return self.do(speed_request(step))

    def fan(self, state: str | None = None) -> R:
        """Toggle the fan, or turn it `on` or `off`. On and off work only while the gateway knows the fan's state."""
        return self.do(fan_request(state))

    def stop(self) -> R:
        """Stop the car, and keep the coordinator from moving it. Wait until the stop is complete."""
        return self.do(stop_request())

    def estop(self, why: str = "") -> R:
        """Emergency-stop the car: it accepts only stops and `resume` until the e-stop ends.

        To end it, call `resume` with its id, or with `everything`.
        """
        return self.do(estop_request(why, Scope.CAR))

    def resume(self, ids: Sequence[str] = (), *, everything: bool = False) -> R:
        """End the e-stops with these ids; a str is one id. Without ids, end the hold that a stop left.

        With `everything`, end the hold and every e-stop that this sender may end.
        """
        return self.do(resume_request(ids, everything=everything))

    def lend(self, to: str, duration_s: float) -> R:
        """Lend the car to a person. For `duration_s`, only that person and leads can drive it."""
        return self.do(lend_request(to, duration_s))

    def end_loan(self) -> R:
        """End the loan of the car, and stop it if the borrower drives it."""
        return self.do(end_loan_request())

    def find(self) -> R:
        """Let the car blink, and beep if it can, so that people see which one it is. It does not move."""
        return self.do(plain_request(Verb.FIND))
