"""Commands as control sees them: parsed, in range, and of a known age; and their answers. Values only."""

from dataclasses import dataclass
from enum import StrEnum

from gateway.protocol.enums import Mode, Motion, SpeedStep
from gateway.protocol.frames import Frame


class SenderKind(StrEnum):
    """What a sender is; a person outranks a script, a script the coordinator."""

    PERSON = "person"
    SCRIPT = "script"
    COORDINATOR = "coordinator"


class Reason(StrEnum):
    """Why a command was not, or is no longer, carried out. The closed set of the answers."""

    BAD_VALUE = "bad_value"
    UNSUPPORTED = "unsupported"
    WRONG_MODE = "wrong_mode"
    LEASED = "leased"
    HELD = "held"
    ESTOPPED = "estopped"
    BATTERY_LOW = "battery_low"
    LINK_DOWN = "link_down"
    WRITE_FAILED = "write_failed"
    QUEUE_FULL = "queue_full"
    EXPIRED = "expired"
    SUPERSEDED = "superseded"
    DUPLICATE = "duplicate"
    STALE = "stale"
    NOT_SHOWN = "not_shown"
    """A stop: the car could have shown it and did not."""


class Phase(StrEnum):
    """One step in the life of a command."""

    ASKED = "asked"
    QUEUED = "queued"
    SENT = "sent"
    EFFECT_SEEN = "effect_seen"
    COMPLETE = "complete"
    SUPERSEDED = "superseded"
    EXPIRED = "expired"
    FAILED = "failed"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class Sender:
    """Who asks."""

    name: str = "anonymous"
    kind: SenderKind = SenderKind.SCRIPT


@dataclass(frozen=True, slots=True)
class Drive:
    """Hold a motion for `duration_s` seconds from its arrival, then stop. `Motion.STOP` releases."""

    motion: Motion
    duration_s: float = 0.5


@dataclass(frozen=True, slots=True)
class SetMode:
    """Bring the car into a mode; `Mode.MANUAL` closes whatever is open."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class OneShot:
    """A frame that acts once: light, servo, whistle, arm. A general frame's motion is filled in when it is sent."""

    frame: Frame


@dataclass(frozen=True, slots=True)
class ChangeSpeed:
    """One step of the car's relative speed."""

    step: SpeedStep


@dataclass(frozen=True, slots=True)
class Fan:
    """Toggle the fan, or bring it to a state, which takes a known one."""

    on: bool | None = None


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop, and hold the car against the coordinator unless the coordinator asked."""


@dataclass(frozen=True, slots=True)
class EmergencyStop:
    """Stop, and refuse everything until it is ended by its id. `fleet_wide`: every gateway of the fleet latches it."""

    why: str = ""
    fleet_wide: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """End the e-stops of these ids; without ids, the hold."""

    ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TakeLease:
    """Reserve the car for the sender for a moment, or give it back."""

    release: bool = False


@dataclass(frozen=True, slots=True)
class Find:
    """Make the car blink and beep, without moving it."""


Action = Drive | SetMode | OneShot | ChangeSpeed | Fan | Stop | EmergencyStop | Resume | TakeLease | Find


@dataclass(frozen=True, slots=True)
class Command:
    """One command as control sees it: parsed, in range, and of a known age."""

    id: str
    verb: str
    sender: Sender
    what: Action
    age_s: float | None = None
    """Seconds from asking to arrival; None if the command does not say when it was asked, which counts as fresh."""
    ttl_s: float = 2.0
    take: bool = False
    """A person takes the car from an equal."""
    note: str = ""
    """What was wrong with a stop that is carried out all the same."""
    asked_ns: int = 0
    """Wall clock, ns since the epoch."""
    streamed: bool = False
    """One of a stream of publications: nobody waits for an answer, and repetitions are not recorded one by one."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the sender is told at once. `status`: sent, queued or rejected."""

    status: Phase
    reason: Reason | None = None
    words: str = ""
    worst_case_s: float = 0.0
