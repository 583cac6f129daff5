"""Decides whether a command may be carried out now: a table of what each command needs, and a rule for each need.

Pure: takes the context of the car, returns a refusal or None. A stop or e-stop passes in every state.
"""

from dataclasses import dataclass
from typing import Final

from gateway.control.commands import (
    Action,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    Fan,
    Find,
    OneShot,
    Reason,
    Resume,
    SenderKind,
    SetMode,
    Stop,
    TakeLease,
)
from gateway.control.safety import Estop, LeaseState
from gateway.protocol.enums import Mode, Motion
from gateway.protocol.frames import ArmSet, General, Ptz
from gateway.protocol.platforms import Profile

MAX_QUEUED_COMMANDS: Final = 8
"""Maximum one-shots in the queue; more are refused."""


@dataclass(frozen=True, slots=True)
class CommandContext:
    """The state of the car and the gateway that decides about a command."""

    car: str
    profile: Profile
    now: float
    link_open: bool
    link_reason: str
    answering: bool
    """False if the car was silent for too long."""
    closing: bool
    asked: Mode | None
    """The commanded mode, also one that still waits."""
    contradicted: bool
    """True if readings or silence contradict the commanded mode."""
    held_by: str | None
    estops: tuple[Estop, ...]
    ended: tuple[str, ...]
    """Ids of ended e-stops."""
    lease: LeaseState | None
    battery: str
    """Why the battery allows no new drive; empty if it does."""
    fan: bool | None
    queued: int
    speed: float = 0.0
    """Estimated speed, in the unit of the profile's speed model."""
    speed_max: float = 1.0
    """Maximum share of full speed, 0..1, after a speed step."""


@dataclass(frozen=True, slots=True)
class Needs:
    """The conditions for a command."""

    not_estopped: bool = True
    not_held: bool = True
    """For a coordinator: the car must not be on hold."""
    lease: bool = False
    """No sender of the same or a higher rank may hold the lease."""
    battery: bool = False
    link: bool = True
    manual: bool = False
    """The car must be in mode 0; it ignores the command in other modes."""
    queue: bool = False


_ANYTIME: Final = Needs(not_estopped=False, not_held=False, link=False)
_MOVES: Final = Needs(lease=True, battery=True, manual=True)
_ACTS: Final = Needs(manual=True, queue=True)
_ADJUSTS: Final = Needs(lease=True, manual=True, queue=True)

RELEASE: Final = Needs(lease=True)
"""Needs of a drive with motion stop, which moves nothing."""
CLOSE: Final = Needs(lease=True)
"""Needs of mode manual, which stops the car."""
TABLE: Final[dict[type[Action], Needs]] = {
    Stop: _ANYTIME,
    EmergencyStop: _ANYTIME,
    Resume: _ANYTIME,
    TakeLease: Needs(lease=True, link=False),
    Drive: _MOVES,
    SetMode: Needs(lease=True, battery=True),
    OneShot: _ACTS,
    ChangeSpeed: _ADJUSTS,
    Fan: _ADJUSTS,
    Find: _ACTS,
}

Refusal = tuple[Reason, str]


def needs(what: Action) -> Needs:
    """Return the needs of a command."""
    match what:
        case Drive(Motion.STOP):
            return RELEASE
        case SetMode(Mode.MANUAL):
            return CLOSE
        case TakeLease(release=True):
            return _ANYTIME
        case OneShot(Ptz() | ArmSet()):
            return _ADJUSTS
        case OneShot(General() as frame) if frame.servo is not None:
            return _ADJUSTS
        case _:
            return TABLE[type(what)]


def refuse(command: Command, context: CommandContext) -> Refusal | None:
    """Return why the command is refused; None if it is accepted. The words name the car, the state, and what to do."""
    what = command.what
    if isinstance(what, Stop | EmergencyStop):
        return None
    if command.age_s is not None and command.age_s > command.ttl_s:
        return Reason.STALE, f"{command.age_s:.1f} s old on arrival, at most {command.ttl_s:g} s is allowed: ask again"
    unknown = _unknown(what, context)
    if unknown is not None:
        return Reason.UNSUPPORTED, unknown
    if isinstance(what, Resume):
        return _resume(what, command.sender.kind, context)
    return _unmet(command, needs(what), context)


def _unknown(what: Action, context: CommandContext) -> str | None:
    """Return why this car cannot do it in any state; None if it can."""
    profile = context.profile
    match what:
        case SetMode(mode) if mode is not Mode.MANUAL and mode not in profile.modes:
            known = ", ".join(sorted(profile.modes))
            return f"a {profile.name} car does not know mode {mode}; it knows: {known}"
        case OneShot(frame):
            return profile.refusal(frame)
        case ChangeSpeed(step):
            after = profile.speed.step(context.speed, step)
            share = profile.speed.fraction(after)
            if after > context.speed and share > context.speed_max:
                return (
                    f"{context.car} would drive at about {share:.0%} of full speed, "
                    f"and {context.speed_max:.0%} is allowed (--speed-max)"
                )
            return profile.refusal(General(Motion.STOP, speed=step))
        case Fan(on):
            words = profile.refusal(General(Motion.STOP, fan=True))
            if words is None and on is not None and context.fan is None:
                return f"whether {context.car}'s fan runs is not known: only a toggle is possible (leave the state out)"
            return words
        case Drive(motion):
            return profile.refusal(General(motion))
        case _:
            return None


def _resume(resume: Resume, kind: SenderKind, context: CommandContext) -> Refusal | None:
    if kind is SenderKind.COORDINATOR:
        return Reason.HELD, "a coordinator may not resume a car: a person or a script does"
    in_force = [estop.id for estop in context.estops]
    if resume.ids and not set(resume.ids) & {*in_force, *context.ended}:
        there = f"in force: {', '.join(in_force)}" if in_force else "none is in force"
        return Reason.BAD_VALUE, f"{context.car} has no e-stop {', '.join(resume.ids)}; {there}"
    return None


def _unmet(command: Command, needed: Needs, context: CommandContext) -> Refusal | None:
    """Return the first need that is not met; None if all are."""
    car, sender = context.car, command.sender
    if needed.not_estopped and context.estops:
        first = context.estops[0]
        why = f": {first.why}" if first.why else ""
        ids = " ".join(estop.id for estop in context.estops)
        return Reason.ESTOPPED, f"{car} is e-stopped by {first.by}{why}; a person or script ends it: resume {ids}"
    if needed.not_held and sender.kind is SenderKind.COORDINATOR and context.held_by is not None:
        ends = "a drive, mode or resume by a person or script ends it"
        return Reason.HELD, f"{car} is on hold ({context.held_by} stopped it): {ends}"
    lease, now = context.lease, context.now
    if needed.lease and lease is not None and lease.refuses(sender, now, take=command.take):
        words = f"{car} is driven by {lease.holder.name} ({lease.holder.kind}), for {lease.until - now:.1f} s more"
        if sender.kind is lease.holder.kind is SenderKind.PERSON:
            return Reason.LEASED, f"{words}: wait, or take it"
        return Reason.LEASED, f"{words}: wait" + (
            ", or ask as a person" if sender.kind is not SenderKind.PERSON else ""
        )
    if needed.battery and context.battery:
        return Reason.BATTERY_LOW, context.battery
    if needed.link:
        refusal = _unreachable(context, fan=isinstance(command.what, Fan))
        if refusal is not None:
            return refusal
    if needed.manual and context.asked not in (None, Mode.MANUAL):
        # Name the stop first: a coordinator would open the mode again after a change to manual, but not after a stop.
        helps = "stop it, or bring it to mode manual first"
        return Reason.WRONG_MODE, f"{car} is in mode {context.asked}, where it ignores this: {helps}"
    if needed.manual and context.contradicted:
        return Reason.WRONG_MODE, f"{car} is not in the mode that it was asked for, and may ignore this: stop it first"
    if needed.queue and context.queued >= MAX_QUEUED_COMMANDS:
        return Reason.QUEUE_FULL, f"{context.queued} commands wait for {car} already: ask again in a second"
    return None


def _unreachable(context: CommandContext, *, fan: bool) -> Refusal | None:
    car = context.car
    if context.closing:
        return Reason.LINK_DOWN, f"the gateway of {car} is ending"
    if not context.link_open:
        return Reason.LINK_DOWN, f"{car} cannot be reached: {context.link_reason}"
    if not context.answering and not (
        fan and context.fan is not False
    ):  # a running fan may be the cause of the silence
        words = f"{car} does not answer: no reading for seconds; is it on, its fan off, and the platform right?"
        return Reason.LINK_DOWN, words
    return None
