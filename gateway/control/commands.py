"""The commands that control handles, after parsing and range checks, and their answers: plain values."""

from collections.abc import Mapping
from typing import ClassVar, Final

from msgspec import Struct

from schemas.commands import Verb
from schemas.rights import Sender
from schemas.words import Light, Mode, Motion, Phase, Reason, ServoAction, SpeedStep


class Drive(Struct, frozen=True):
    """Hold a motion for `duration_s` seconds. `Motion.STOP` ends the motion that is held.

    The time begins when the frame of the motion is written. Each further sample of a stream lets it begin again.
    """

    motion: Motion
    duration_s: float = 0.5
    continues: bool = False
    """True: prolong this motion if the same sender holds it, but do not begin it. False: begin it if it is not held."""


class SetMode(Struct, frozen=True):
    """Bring the car into a mode. `Mode.MANUAL` ends the mode in which the car drives by itself."""

    mode: Mode


class PartAction(Struct, frozen=True):
    """An action other than driving: light, servo, arm, speed, fan. It waits in the queue, and needs mode manual.

    `needs_lease` is True if the action moves a part of the car, or changes how the car moves. Then the sender needs the
    lease.
    """

    needs_lease: ClassVar[bool] = True


class Led(PartAction, frozen=True):
    """Set the color LED, 0..255 each."""

    r: int
    g: int
    b: int
    needs_lease: ClassVar[bool] = False


class SetLight(PartAction, frozen=True):
    """Switch the light."""

    light: Light
    needs_lease: ClassVar[bool] = False


class Signal(PartAction, frozen=True):
    """Give the signal of a verb, such as a beep, once or for `duration_s` seconds (see `CommandType.signal`)."""

    verb: Verb
    duration_s: float = 0.0
    needs_lease: ClassVar[bool] = False


class MoveServo(PartAction, frozen=True):
    """Turn a servo one way, which is by one step or to the end, depending on the car. Or turn it to the middle."""

    action: ServoAction


class AimServo(PartAction, frozen=True):
    """Turn the front servo to an angle, 0..180 degrees. The car determines at which end 0 is."""

    deg: int


class MoveArm(PartAction, frozen=True):
    """Move the six joints of an arm, 0..180 degrees each."""

    joint_deg: tuple[int, ...]


class ChangeSpeed(PartAction, frozen=True):
    """Change the car's relative speed by one step."""

    step: SpeedStep


class Fan(PartAction, frozen=True):
    """Toggle the fan, or set it to on or off. Only a fan whose present state is known can be set."""

    on: bool | None = None


class Stop(Struct, frozen=True):
    """Stop the car. Put it on hold, unless the coordinator is the sender."""


class EmergencyStop(Struct, frozen=True):
    """Stop the car, and refuse drives, modes and actions until a resume. If `fleet_wide`, all gateways do so."""

    why: str = ""
    fleet_wide: bool = False


class Resume(Struct, frozen=True):
    """End the e-stops with these ids. Without ids, end the hold. With `all`, end the hold and all e-stops.

    Only what the sender may end is ended.
    """

    ids: tuple[str, ...] = ()
    all: bool = False


class Pause(Struct, frozen=True):
    """Stop the car. Until an `Unpause`, only people of the rank lead may move cars of the fleet."""

    why: str = ""


class Unpause(Struct, frozen=True):
    """End the pauses of the fleet with these ids, or without ids all that are in force. By itself this moves no car."""

    ids: tuple[str, ...] = ()


class Lend(Struct, frozen=True):
    """Lend the car to a person for `duration_s` seconds: meanwhile no other person, except leads, may drive it."""

    to: str
    duration_s: float


class EndLoan(Struct, frozen=True):
    """End the loan of the car."""


class TakeLease(Struct, frozen=True):
    """Reserve the car for the sender for a short time. With `release`, end the sender's lease instead."""

    release: bool = False


class Find(Struct, frozen=True):
    """Make the car blink, and beep if it can, without moving it."""


Action = (
    Drive | SetMode | PartAction | Stop | EmergencyStop | Resume | TakeLease | Find | Pause | Unpause | Lend | EndLoan
)

PLAIN_ACTIONS: Final[Mapping[str, type[Action]]] = {
    Verb.STOP: Stop,
    Verb.LEASE: TakeLease,
    Verb.FIND: Find,
}
"""Actions, by verb, that need no rules of parsing: their fields, if they have any, are flags of the message."""


class Command(Struct, frozen=True):
    """One command, parsed and in range."""

    id: str
    verb: str
    sender: Sender
    what: Action
    age_s: float | None = None
    """Seconds from sending to arrival. None if the time of sending is not known. Then the command counts as fresh."""
    ttl_s: float = 2.0
    take: bool = False
    """True if a person wants to take the car from another person."""
    note: str = ""
    """The error in an invalid stop, which is carried out nevertheless."""
    asked_ns: int = 0
    """When the command arrived, by the wall clock, ns since the epoch."""
    streamed: bool = False
    """True for a sample of a stream: it gets no answer, and repetitions share one record."""


class Answer(Struct, frozen=True):
    """The immediate answer to the sender. `status` is sent, queued or rejected.

    `worst_case_s`: for a stop, the maximum time until the motors are off; 0 for other commands.
    """

    status: Phase
    reason: Reason | None = None
    words: str = ""
    worst_case_s: float = 0.0
