"""The commands that control takes, after parsing and range checks, and their answers. Values only."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gateway.protocol.frames import ArmSet, Frame, General, Ptz
from schemas.authority import Sender
from schemas.words import Mode, Motion, Phase, Reason, SpeedStep, Verb


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


class FrameAction(ABC):
    """An action that sends frames in mode 0, one after the other. A general frame gets the current motion."""

    __slots__ = ()

    @property
    @abstractmethod
    def frames(self) -> tuple[Frame, ...]:
        """The frames to send."""

    @property
    def needs_lease(self) -> bool:
        """True if only the driver of a car may do it: it moves a part of the car, or changes how the car moves."""
        return True


@dataclass(frozen=True, slots=True)
class OneShot(FrameAction):
    """Send a frame that acts once: light, servo, whistle, arm."""

    frame: Frame

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frame."""
        return (self.frame,)

    @property
    def needs_lease(self) -> bool:
        """True for a servo and the arm."""
        frame = self.frame
        return isinstance(frame, Ptz | ArmSet) or (isinstance(frame, General) and frame.servo is not None)


@dataclass(frozen=True, slots=True)
class ChangeSpeed(FrameAction):
    """Change the car's relative speed by one step."""

    step: SpeedStep

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frame of one step."""
        return (General(Motion.STOP, speed=self.step),)


@dataclass(frozen=True, slots=True)
class Fan(FrameAction):
    """Toggle the fan, or bring it to a state. For that its current state must be known."""

    on: bool | None = None

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frame that toggles the fan."""
        return (General(Motion.STOP, fan=True),)


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop the car. Put it on hold, unless the coordinator is the sender."""


@dataclass(frozen=True, slots=True)
class EmergencyStop:
    """Stop the car, and refuse commands until a resume with this id. `fleet_wide`: all gateways latch it."""

    why: str = ""
    fleet_wide: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """End the e-stops of these ids. Without ids, end the hold. `all`: end both, as far as the sender may."""

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
    """Make the car blink and beep, without moving it."""


Action = (
    Drive
    | SetMode
    | OneShot
    | ChangeSpeed
    | Fan
    | Stop
    | EmergencyStop
    | Resume
    | TakeLease
    | Find
    | Pause
    | Unpause
    | Lend
    | EndLoan
)

PLAIN_ACTIONS: Final[Mapping[str, type[Action]]] = {
    Verb.STOP: Stop,
    Verb.UNPAUSE: Unpause,
    Verb.LEASE: TakeLease,
    Verb.FIND: Find,
}
"""Actions by verb whose fields are those of the message, flags or `duration_s`, and need no rule of their own."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command, parsed and in range."""

    id: str
    verb: str
    sender: Sender
    what: Action
    age_s: float | None = None
    """Seconds from sending to arrival; None if the command has no time, which counts as fresh."""
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
    """The immediate answer to the sender. `status`: sent, queued or rejected."""

    status: Phase
    reason: Reason | None = None
    words: str = ""
    worst_case_s: float = 0.0
