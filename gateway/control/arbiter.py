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
        return (
            Reason.STALE,
            f"the command arrived {command.age_s:.1f} s late (maximum {command.ttl_s:g} s). Send it again.",
        )
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
            return f"{context.car} ({profile.name}) has no mode {mode}. It has: {known}."
        case OneShot(frame):
            return profile.refusal(frame)
        case ChangeSpeed(step):
            after = profile.speed.step(context.speed, step)
            share = profile.speed.fraction(after)
            if after > context.speed and share > context.speed_max:
                return (
                    f"{context.car} would drive at about {share:.0%} of full speed. "
                    f"Its maximum is {context.speed_max:.0%} (speed_max)."
                )
            return profile.refusal(General(Motion.STOP, speed=step))
        case Fan(on):
            words = profile.refusal(General(Motion.STOP, fan=True))
            if words is None and on is not None and context.fan is None:
                return (
                    f"{context.car}'s fan state is unknown, so on/off is not possible. "
                    f"Toggle it: `fleet fan {context.car}`."
                )
            return words
        case Drive(motion):
            return profile.refusal(General(motion))
        case _:
            return None


def _resume(resume: Resume, kind: SenderKind, context: CommandContext) -> Refusal | None:
    if kind is SenderKind.COORDINATOR:
        return (
            Reason.HELD,
            f"{context.car} stays on hold: only a person or a script may resume it, not the coordinator.",
        )
    in_force = [estop.id for estop in context.estops]
    if resume.ids and not set(resume.ids) & {*in_force, *context.ended}:
        there = f"In force: {', '.join(in_force)}." if in_force else "None is in force."
        return Reason.BAD_VALUE, f"{context.car} has no e-stop {', '.join(resume.ids)}. {there}"
    return None


def _unmet(command: Command, needed: Needs, context: CommandContext) -> Refusal | None:
    """Return the first need that is not met; None if all are."""
    car, sender = context.car, command.sender
    if needed.not_estopped and context.estops:
        first = context.estops[0]
        why = f': "{first.why}"' if first.why else ""
        return (
            Reason.ESTOPPED,
            f"{car} is emergency-stopped ({first.by}{why}). Release it with `fleet resume {car} --estops`.",
        )
    if needed.not_held and sender.kind is SenderKind.COORDINATOR and context.held_by is not None:
        return Reason.HELD, f"{car} is on hold ({context.held_by} stopped it). End the hold with `fleet resume {car}`."
    lease, now = context.lease, context.now
    if needed.lease and lease is not None and lease.refuses(sender, now, take=command.take):
        words = f"{car} is driven by {lease.holder.name} ({lease.holder.kind}) for another {lease.until - now:.1f} s."
        if sender.kind is lease.holder.kind is SenderKind.PERSON:
            return Reason.LEASED, f"{words} Wait, or take the car over (--take)."
        return Reason.LEASED, f"{words} Wait until the car is free."
    if needed.battery and context.battery:
        return Reason.BATTERY_LOW, context.battery
    if needed.link:
        refusal = _unreachable(context, fan=isinstance(command.what, Fan))
        if refusal is not None:
            return refusal
    if needed.manual and context.asked not in (None, Mode.MANUAL):
        # Where a plan runs, only a stop lasts: the coordinator would open the mode again after a change to manual.
        fix = f"`fleet mode {car} manual` (or `fleet stop {car}` if a plan runs)"
        return (
            Reason.WRONG_MODE,
            f"{car} ignores {command.verb} commands while in mode {context.asked}. First: {fix}.",
        )
    if needed.manual and context.contradicted:
        words = f"{car} may ignore this: its readings do not fit mode {context.asked}. First: `fleet stop {car}`."
        return Reason.WRONG_MODE, words
    if needed.queue and context.queued >= MAX_QUEUED_COMMANDS:
        return Reason.QUEUE_FULL, f"{car} is busy: {context.queued} commands wait already. Try again in a second."
    return None


def _unreachable(context: CommandContext, *, fan: bool) -> Refusal | None:
    car = context.car
    if context.closing:
        return Reason.LINK_DOWN, f"the gateway of {car} is shutting down."
    if not context.link_open:
        return Reason.LINK_DOWN, f"{car} is unreachable: {context.link_reason}"
    if not context.answering and not (
        fan and context.fan is not False
    ):  # a running fan may be the cause of the silence
        checks = "Check: switched on? in range? fan off? `platform:` right?"
        words = f"{car} is silent: no readings arrive. {checks} `gateway monitor` shows its bytes."
        return Reason.LINK_DOWN, words
    return None
