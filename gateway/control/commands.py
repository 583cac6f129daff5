"""The commands that control takes, after parsing and range checks, and their answers. Values only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

from schemas.commands import Verb
from schemas.rights import Sender
from schemas.words import Light, Mode, Motion, Phase, Reason, ServoAction, SpeedStep


@dataclass(frozen=True, slots=True)
class Drive:
    """Hold a motion for `duration_s` seconds from the arrival of the command. `Motion.STOP` releases it."""

    motion: Motion
    duration_s: float = 0.5
    continues: bool = False
    """True to prolong this motion of the same sender while it lasts. False to begin it, too."""


@dataclass(frozen=True, slots=True)
class SetMode:
    """Bring the car into a mode. `Mode.MANUAL` closes the open mode."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class PartAction:
    """An action on a part of a car: light, servo, arm, speed, fan. It waits in the queue of a car in mode 0.

    With `needs_lease`, only the driver of a car may do it. It moves a part of the car, or changes how the car moves.
    """

    needs_lease: ClassVar[bool] = True


@dataclass(frozen=True, slots=True)
class Led(PartAction):
    """Set the color LED, 0..255 each."""

    r: int
    g: int
    b: int
    needs_lease: ClassVar[bool] = False


@dataclass(frozen=True, slots=True)
class SetLight(PartAction):
    """Switch the light."""

    light: Light
    needs_lease: ClassVar[bool] = False


@dataclass(frozen=True, slots=True)
class Signal(PartAction):
    """Give the signal of a verb, such as a beep, once or for `duration_s` seconds. Its row has `signal` set."""

    verb: Verb
    duration_s: float = 0.0
    needs_lease: ClassVar[bool] = False


@dataclass(frozen=True, slots=True)
class MoveServo(PartAction):
    """Move a servo by one step, or to its middle."""

    action: ServoAction


@dataclass(frozen=True, slots=True)
class AimServo(PartAction):
    """Turn the front servo to an angle, 0..180 degrees, as the car counts them."""

    deg: int


@dataclass(frozen=True, slots=True)
class MoveArm(PartAction):
    """Move the six joints of an arm, 0..180 degrees each."""

    joint_deg: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ChangeSpeed(PartAction):
    """Change the car's relative speed by one step."""

    step: SpeedStep


@dataclass(frozen=True, slots=True)
class Fan(PartAction):
    """Toggle the fan, or bring it to a state. For that its current state must be known."""

    on: bool | None = None


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop the car. Put it on hold, unless the coordinator is the sender."""


@dataclass(frozen=True, slots=True)
class EmergencyStop:
    """Stop the car, and refuse commands until a resume with this id. If `fleet_wide`, all gateways latch it."""

    why: str = ""
    fleet_wide: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """End the e-stops with these ids, or without ids the hold. With `all`, end both, as far as the sender may."""

    ids: tuple[str, ...] = ()
    all: bool = False


@dataclass(frozen=True, slots=True)
class Pause:
    """Stop the car, and let only leads move the cars of the fleet until an `Unpause`."""

    why: str = ""


@dataclass(frozen=True, slots=True)
class Unpause:
    """End the pause of the fleet. Move nothing."""


@dataclass(frozen=True, slots=True)
class Lend:
    """Let only this person, of all persons and scripts, drive the car for `duration_s` seconds."""

    to: str
    duration_s: float


@dataclass(frozen=True, slots=True)
class EndLoan:
    """End the loan of the car."""


@dataclass(frozen=True, slots=True)
class TakeLease:
    """Reserve the car for the sender for a short time, or end its lease."""

    release: bool = False


@dataclass(frozen=True, slots=True)
class Find:
    """Make the car blink, and beep if it can, without moving it."""


Action = (
    Drive | SetMode | PartAction | Stop | EmergencyStop | Resume | TakeLease | Find | Pause | Unpause | Lend | EndLoan
)

PLAIN_ACTIONS: Final[Mapping[str, type[Action]]] = {
    Verb.STOP: Stop,
    Verb.UNPAUSE: Unpause,
    Verb.LEASE: TakeLease,
    Verb.FIND: Find,
}
"""Actions by verb whose fields are flags of the message, and need no rule of their own."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command, parsed and in range."""

    id: str
    verb: str
    sender: Sender
    what: Action
    age_s: float | None = None
    """Seconds from sending to arrival, or None if the command has no time, which counts as fresh."""
    ttl_s: float = 2.0
    take: bool = False
    """True if a person takes the car from another person."""
    note: str = ""
    """The error in a stop that is carried out all the same."""
    asked_ns: int = 0
    """Wall clock, ns since the epoch."""
    streamed: bool = False
    """True for one of a stream of publications: nobody waits for an answer, and repetitions share one record."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The immediate answer to the sender. `status` is sent, queued or rejected."""

    status: Phase
    reason: Reason | None = None
    words: str = ""
    worst_case_s: float = 0.0
