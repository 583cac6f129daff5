"""May this command be carried out on this car now? One table of what each command needs, and one rule for each need.

Pure: a picture of the car in, a refusal or none out. From every state stop and estop are let through.
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

QUEUE_LIMIT: Final = 8
"""One-shots that may wait; more are refused."""


@dataclass(frozen=True, slots=True)
class CommandContext:
    """What the arbiter looks at."""

    car: str
    profile: Profile
    now: float
    link_open: bool
    link_reason: str
    answering: bool
    """False once recovery has given up, or the car was silent for too long: motors unknown."""
    closing: bool
    asked: Mode | None
    """The mode the car is in, or is about to be in."""
    contradicted: bool
    """Its readings show another mode, or none at all."""
    held_by: str | None
    estops: tuple[Estop, ...]
    ended: tuple[str, ...]
    """Ids of e-stops that were ended."""
    lease: LeaseState | None
    battery: str
    """Why the battery allows no new drive, in words; empty if it does."""
    fan: bool | None
    queued: int
    speed: float = 0.0
    """As a number of the profile's speed model; an estimate."""
    speed_max: float = 1.0
    """The greatest share of full speed, 0..1, to which a step may lead."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What must be so before a command is carried out."""

    not_estopped: bool = True
    not_held: bool = True
    """Of a coordinator: that the car is not on hold."""
    lease: bool = False
    """That nobody who ranks as high drives the car."""
    battery: bool = False
    link: bool = True
    manual: bool = False
    """Mode 0, in which alone the car obeys it."""
    queue: bool = False


_ANYTIME: Final = Needs(not_estopped=False, not_held=False, link=False)
_MOVES: Final = Needs(lease=True, battery=True, manual=True)
_ACTS: Final = Needs(manual=True, queue=True)
_TURNS: Final = Needs(lease=True, manual=True, queue=True)

RELEASE: Final = Needs(lease=True)
"""A drive with motion stop: it moves nothing."""
CLOSE: Final = Needs(lease=True)
"""Mode manual: it stops the car."""
TABLE: Final[dict[type[Action], Needs]] = {
    Stop: _ANYTIME,
    EmergencyStop: _ANYTIME,
    Resume: _ANYTIME,
    TakeLease: Needs(lease=True, link=False),
    Drive: _MOVES,
    SetMode: Needs(lease=True, battery=True),
    OneShot: _ACTS,
    ChangeSpeed: _TURNS,
    Fan: _TURNS,
    Find: _ACTS,
}

Refusal = tuple[Reason, str]


def needs(what: Action) -> Needs:
    """What this command needs."""
    match what:
        case Drive(Motion.STOP):
            return RELEASE
        case SetMode(Mode.MANUAL):
            return CLOSE
        case TakeLease(release=True):
            return _ANYTIME
        case OneShot(Ptz() | ArmSet()):
            return _TURNS
        case OneShot(General() as frame) if frame.servo is not None:
            return _TURNS
        case _:
            return TABLE[type(what)]


def refuse(command: Command, situation: CommandContext) -> Refusal | None:
    """Why the command is refused, or None. The words name the car, the state, and what to do."""
    what = command.what
    if isinstance(what, Stop | EmergencyStop):
        return None
    if command.age_s is not None and command.age_s > command.ttl_s:
        return Reason.STALE, f"{command.age_s:.1f} s old on arrival, at most {command.ttl_s:g} s is allowed: ask again"
    unknown = _unknown(what, situation)
    if unknown is not None:
        return Reason.UNSUPPORTED, unknown
    if isinstance(what, Resume):
        return _resume(what, command.sender.kind, situation)
    return _unmet(command, needs(what), situation)


def _unknown(what: Action, situation: CommandContext) -> str | None:
    """Why this car could never do it, or must not."""
    profile = situation.profile
    match what:
        case SetMode(mode) if mode is not Mode.MANUAL and mode not in profile.modes:
            known = ", ".join(sorted(profile.modes))
            return f"a {profile.name} car does not know mode {mode}; it knows: {known}"
        case OneShot(frame):
            return profile.refusal(frame)
        case ChangeSpeed(step):
            after = profile.speed.step(situation.speed, step)
            share = profile.speed.fraction(after)
            if after > situation.speed and share > situation.speed_max:
                return (
                    f"{situation.car} would drive at about {share:.0%} of full speed, "
                    f"and {situation.speed_max:.0%} is allowed (--speed-max)"
                )
            return profile.refusal(General(Motion.STOP, speed=step))
        case Fan(on):
            words = profile.refusal(General(Motion.STOP, fan=True))
            if words is None and on is not None and situation.fan is None:
                return (
                    f"whether {situation.car}'s fan runs is not known: only a toggle is possible (leave the state out)"
                )
            return words
        case Drive(motion):
            return profile.refusal(General(motion))
        case _:
            return None


def _resume(resume: Resume, kind: SenderKind, situation: CommandContext) -> Refusal | None:
    if kind is SenderKind.COORDINATOR:
        return Reason.HELD, "a coordinator may not resume a car: a person or a script does"
    in_force = [estop.id for estop in situation.estops]
    if resume.ids and not set(resume.ids) & {*in_force, *situation.ended}:
        there = f"in force: {', '.join(in_force)}" if in_force else "none is in force"
        return Reason.BAD_VALUE, f"{situation.car} has no e-stop {', '.join(resume.ids)}; {there}"
    return None


def _unmet(command: Command, needed: Needs, situation: CommandContext) -> Refusal | None:
    """The first need that is not met."""
    car, sender = situation.car, command.sender
    if needed.not_estopped and situation.estops:
        first = situation.estops[0]
        why = f": {first.why}" if first.why else ""
        ids = " ".join(estop.id for estop in situation.estops)
        return Reason.ESTOPPED, f"{car} is e-stopped by {first.by}{why}; a person or script ends it: resume {ids}"
    if needed.not_held and sender.kind is SenderKind.COORDINATOR and situation.held_by is not None:
        ends = "a drive, mode or resume by a person or script ends it"
        return Reason.HELD, f"{car} is on hold ({situation.held_by} stopped it): {ends}"
    lease, now = situation.lease, situation.now
    if needed.lease and lease is not None and lease.refuses(sender, now, take=command.take):
        words = f"{car} is driven by {lease.holder.name} ({lease.holder.kind}), for {lease.until - now:.1f} s more"
        if sender.kind is lease.holder.kind is SenderKind.PERSON:
            return Reason.LEASED, f"{words}: wait, or take it"
        return Reason.LEASED, f"{words}: wait" + (
            ", or ask as a person" if sender.kind is not SenderKind.PERSON else ""
        )
    if needed.battery and situation.battery:
        return Reason.BATTERY_LOW, situation.battery
    if needed.link:
        refusal = _unreachable(situation, fan=isinstance(command.what, Fan))
        if refusal is not None:
            return refusal
    if needed.manual and situation.asked not in (None, Mode.MANUAL):
        # The stop first: under a coordinator, which would bring a mode back, it is what helps.
        helps = "stop it, or bring it to mode manual first"
        return Reason.WRONG_MODE, f"{car} is in mode {situation.asked}, where it ignores this: {helps}"
    if needed.manual and situation.contradicted:
        return Reason.WRONG_MODE, f"{car} is not in the mode that it was asked for, and may ignore this: stop it first"
    if needed.queue and situation.queued >= QUEUE_LIMIT:
        return Reason.QUEUE_FULL, f"{situation.queued} commands wait for {car} already: ask again in a second"
    return None


def _unreachable(situation: CommandContext, *, fan: bool) -> Refusal | None:
    car = situation.car
    if situation.closing:
        return Reason.LINK_DOWN, f"the gateway of {car} is ending"
    if not situation.link_open:
        return Reason.LINK_DOWN, f"{car} cannot be reached: {situation.link_reason}"
    if not situation.answering and not (fan and situation.fan is not False):  # it may be what silences the car
        words = f"{car} does not answer: no reading for seconds; is it on, its fan off, and the platform right?"
        return Reason.LINK_DOWN, words
    return None
