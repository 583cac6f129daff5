"""Decides whether a command may be carried out now: a table of what each command needs, and a rule for each need.

Pure: takes the context of the car, returns a refusal or None. A stop or e-stop passes in every state.
"""

from dataclasses import dataclass, replace
from typing import Final

from gateway.control.commands import (
    Action,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    FrameAction,
    Lend,
    Pause,
    Resume,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.people import NO_PEOPLE, People, PersonRole, Sender
from gateway.control.safety import Estop, FleetPause, Hold, LeaseState, Loan
from gateway.protocol.frames import General
from gateway.protocol.platforms import Profile
from schemas.suggestion import did_you_mean
from schemas.words import Mode, Motion, Platform, Rank, Reason, SpeedStep

MAX_QUEUED_COMMANDS: Final = 8
"""Maximum one-shots in the queue; more are refused."""
MAX_AHEAD_S: Final = 5.0
"""Maximum time by which `asked` may lie in the future. Clocks of computers differ by less if they are set by NTP."""
CLOCK_DOUBT_S: Final = 30.0
"""Minimum lateness of a command that is rather a wrong clock than a slow network."""
AFTER_SLEEP_S: Final = 2.0
"""Time after a sleep of the computer in which a command without `asked` may be from before it."""


@dataclass(frozen=True, slots=True)
class CommandContext:
    """The state of the car and the gateway that decides about a command."""

    car: str
    profile: Profile
    now: float
    link_open: bool
    link_reason: str
    closing: bool
    asked: Mode | None
    """The commanded mode, also one that still waits."""
    hold: Hold | None
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
    people: People = NO_PEOPLE
    pauses: tuple[FleetPause, ...] = ()
    loan: Loan | None = None
    loan_until: float = 0.0
    slept_at: float = float("-inf")
    """When the last sleep of the computer was noticed."""


@dataclass(frozen=True, slots=True)
class Needs:
    """The conditions for a command."""

    allowed: bool = True
    """The sender may drive the car, nobody else has borrowed it, and neither an e-stop nor a pause is in force."""
    not_held: bool = True
    """The car must not be on hold. This holds for a coordinator; after the stop of a lead for all but leads."""
    lease: bool = False
    """No sender of the same or a higher rank may hold the lease."""
    battery: bool = False
    link: bool = True
    manual: bool = False
    """The car must be in mode 0; it ignores the command in other modes."""
    queue: bool = False


_ANYTIME: Final = Needs(allowed=False, not_held=False, link=False)
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
    Pause: _ANYTIME,
    Unpause: _ANYTIME,
    Lend: _ANYTIME,
    EndLoan: _ANYTIME,
    TakeLease: Needs(lease=True, link=False),
    Drive: _MOVES,
    SetMode: Needs(lease=True, battery=True),
    Find: _ACTS,
}
"""Needs of each action that is no `FrameAction`."""

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
        case FrameAction():
            return _ADJUSTS if what.needs_lease else _ACTS
        case _:
            return TABLE[type(what)]


def refuse(command: Command, context: CommandContext) -> Refusal | None:
    """Return why the command is refused; None if it is accepted. The words name the car, the state, and what to do."""
    what, sender = command.what, command.sender
    if isinstance(what, Stop | EmergencyStop):
        return None
    if isinstance(what, Pause):  # late is better than never, as of a stop
        return _may_direct(sender, "pause the fleet", context)
    if (words := _out_of_time(command, context)) is not None:
        return Reason.STALE, words
    unknown = _unknown(what, context)
    if unknown is not None:
        return Reason.UNSUPPORTED, unknown
    match what:
        case Resume():
            return _resume(what, sender, context)
        case Unpause():
            return _may_direct(sender, "end the pause", context) or _pause_stays(sender, context)
        case Lend():
            refusal = _may_direct(sender, f"lend {context.car}", context) or _may_drive(sender, context)
            return refusal or _unknown_borrower(what.to, context)
        case EndLoan() if context.loan is not None and context.loan.to != sender.person:
            return _may_direct(sender, f"end the loan of {context.car}", context)
        case _:
            return _unmet(command, needs(what), context)


def _out_of_time(command: Command, context: CommandContext) -> str | None:
    """Return why the time of the command is no time of now; None if it is, or if the command has no time."""
    age_s, clocks = command.age_s, f"Set the clock of its computer, or of the one that runs {context.car}'s gateway."
    if age_s is None:
        if context.now < context.slept_at + AFTER_SLEEP_S:
            return "the computer has just slept, and the command may be from before. Send it again, with `asked`."
        return None
    if age_s < -MAX_AHEAD_S:
        limit = f"maximum {MAX_AHEAD_S:g} s"
        return f"the command was asked {-age_s:.0f} s in the future by its sender's clock ({limit}). {clocks}"
    if age_s <= command.ttl_s:
        return None
    words = f"the command arrived {age_s:.1f} s late (maximum {command.ttl_s:g} s). Send it again."
    return words if age_s < CLOCK_DOUBT_S else f"{words} If that does not help: {clocks.lower()[0]}{clocks[1:]}"


def _unknown(what: Action, context: CommandContext) -> str | None:
    """Return why this car cannot do it in any state; None if it can."""
    profile = context.profile
    match what:
        case SetMode(mode) if mode is not Mode.MANUAL and mode not in profile.modes:
            if profile.kind is Platform.UNKNOWN:
                return (
                    f"the platform of {context.car} is not known, and a mode frame ends the program of some cars. "
                    f"Name it: `platform:` in the fleet file, or `gateway run --platform`."
                )
            known = ", ".join(sorted(profile.modes))
            return f"{context.car} ({profile.name}) has no mode {mode}. It has: {known}."
        case ChangeSpeed(step) if (words := _too_fast(step, context)) is not None:
            return words
        case FrameAction():
            words = next((refusal for frame in what.frames if (refusal := profile.refusal(frame))), None)
            is_unknown = context.fan is None and not profile.fan_is_level
            if words is None and isinstance(what, Fan) and what.on is not None and is_unknown:
                return (
                    f"{context.car}'s fan state is unknown, so on/off is not possible. "
                    f"Toggle it: `fleet fan {context.car}`."
                )
            return words
        case Drive(motion):
            return profile.refusal(General(motion))
        case _:
            return None


def _too_fast(step: SpeedStep, context: CommandContext) -> str | None:
    """Return why the car must not become as fast as after this step; None if it may."""
    speed = context.profile.speed
    after = speed.step(context.speed, step)
    share = speed.fraction(after)
    if after <= context.speed or share <= context.speed_max:
        return None
    return (
        f"{context.car} would drive at about {share:.0%} of full speed. "
        f"Its maximum is {context.speed_max:.0%} (speed_max)."
    )


def _may_direct(sender: Sender, deed: str, context: CommandContext) -> Refusal | None:
    """Return why this sender may not pause or lend: where there are leads, only they may; elsewhere every person."""
    leads, person = context.people.leads, sender.person
    if sender.kind is Rank.LEAD:
        return None
    if leads:
        return Reason.NOT_ALLOWED, f"{person} may not {deed}: only a lead may ({', '.join(leads)})."
    if sender.kind is not Rank.PERSON:
        return Reason.NOT_ALLOWED, f'a {sender.kind} may not {deed}: only a person may. Send kind "person".'
    return _unlisted(sender, context) if context.people.role(person) is None else None


def _unknown_borrower(person: str, context: CommandContext) -> Refusal | None:
    roles = context.people.roles
    if roles is None or person in roles:
        return None
    near = did_you_mean(person, roles) or f"There are: {', '.join(sorted(roles))}."
    return Reason.BAD_VALUE, f'`people:` in the fleet file lists no "{person}". {near}'


def _may_drive(sender: Sender, context: CommandContext) -> Refusal | None:
    """Return why the people of the fleet or a loan keep this sender from the car."""
    car, person, people, loan = context.car, sender.person, context.people, context.loan
    if sender.kind is Rank.LEAD:
        return None
    if loan is not None and person != loan.to and person not in people.leads:
        left = f"{context.loan_until - context.now:.0f} s"
        words = f"{car} is lent to {loan.to} for another {left}. {loan.by} ends that with `fleet lend {car} --end`."
        return Reason.LENT, words
    borrowed = loan is not None and person == loan.to
    if sender.kind is Rank.COORDINATOR or borrowed or people.may_drive(person):
        return None
    if people.role(person) is None:
        return _unlisted(sender, context)
    words = f"{person} may not drive {car}: `people:` in the fleet file gives {person} other cars."
    who = f"{', '.join(people.leads)} can lend it" if people.leads else "Somebody who drives it can lend it"
    return Reason.NOT_ALLOWED, f"{words} {who}: `fleet lend {car} --to {person} --for 10m`."


def _unlisted(sender: Sender, context: CommandContext) -> Refusal:
    return Reason.NOT_ALLOWED, (
        f"{sender.person} may watch and stop {context.car}, nothing else: `people:` in the fleet file does not list "
        f"{sender.person}. Say who you are with `--as NAME` or FLEET_AS."
    )


def may_end_estop(estop: Estop, sender: Sender, context: CommandContext) -> bool:
    """Return True if the sender may end this e-stop.

    Only a lead may end a lead's e-stop. Whoever may drive this car may end an e-stop of this car, and every person of
    the fleet may end a fleet-wide one, so that all gateways decide alike. Everybody may end their own.
    """
    people, person = context.people, sender.person
    if sender.kind is Rank.COORDINATOR or not people.may_end(sender, estop.by, estop.rank):
        return False
    mine = person in (Sender(estop.by).person, context.loan and context.loan.to)
    return mine or people.may_drive(person) or (estop.fleet_wide and people.role(person) is PersonRole.OTHER)


def _resume(resume: Resume, sender: Sender, context: CommandContext) -> Refusal | None:
    car = context.car
    if sender.kind is Rank.COORDINATOR:
        return Reason.HELD, f"{car} stays on hold: only a person or a script may resume it, not the coordinator."
    in_force = {estop.id: estop for estop in context.estops}
    if resume.ids and not set(resume.ids) & {*in_force, *context.ended}:
        there = f"In force: {', '.join(in_force)}." if in_force else "None is in force."
        return Reason.BAD_VALUE, f"{car} has no e-stop {', '.join(resume.ids)}. {there}"
    named = [estop for estop in context.estops if resume.all or estop.id in resume.ids]
    stays = [estop for estop in named if not may_end_estop(estop, sender, context)]
    if len(stays) < len(named) or (resume.ids and not named):
        return None
    hold = refuse_end_of_hold(sender, context)
    if stays and (hold is not None or context.hold is None or not resume.all):
        return _estop_stays(stays[0], sender, context)
    return hold


def refuse_end_of_hold(sender: Sender, context: CommandContext) -> Refusal | None:
    """Return why the sender may not end a hold, or None. A loan to another person does not matter here."""
    return _hold_stays(sender, context) or _may_drive_at_all(sender, context)


def _may_drive_at_all(sender: Sender, context: CommandContext) -> Refusal | None:
    loan = context.loan if context.loan is not None and context.loan.to == sender.person else None
    return _may_drive(sender, replace(context, loan=loan))


def _estop_stays(estop: Estop, sender: Sender, context: CommandContext) -> Refusal:
    if context.people.may_end(sender, estop.by, estop.rank):
        return _may_drive_at_all(sender, context) or _unlisted(sender, context)
    why = f': "{estop.why}"' if estop.why else ""
    words = f"{context.car} stays emergency-stopped: {estop.by} did it{why}, and {_only_leads(context)}"
    return Reason.ESTOPPED, words


def _hold_stays(sender: Sender, context: CommandContext) -> Refusal | None:
    hold = context.hold
    if hold is None or context.people.may_end(sender, hold.by, hold.rank):
        return None
    return Reason.HELD, f"{context.car} is on hold: {hold.by} stopped it, and {_only_leads(context)}"


def _pause_stays(sender: Sender, context: CommandContext) -> Refusal | None:
    for pause in context.pauses:
        if not context.people.may_end(sender, pause.by, pause.rank):
            return Reason.PAUSED, f"{context.car} stays paused: {pause.by} did it, and {_only_leads(context)}"
    return None


def _only_leads(context: CommandContext) -> str:
    """Return the rule about what a lead began, and who the leads are."""
    rule, leads = "only a lead ends what a lead began", context.people.leads
    if leads:
        return f"{rule} ({', '.join(leads)})."
    where = "`people:` of the fleet file, or with `--person NAME:lead`"
    return f"{rule}. The gateway of {context.car} knows no leads: name them in {where}."


def _not_allowed(sender: Sender, context: CommandContext) -> Refusal | None:
    """Return why an e-stop, a pause, a loan or the people of the fleet keep the sender from the car."""
    car = context.car
    if context.estops:
        first = context.estops[0]
        why = f': "{first.why}"' if first.why else ""
        words = f"{car} is emergency-stopped ({first.by}{why}). Release it with `fleet resume {car} --estops`."
        return Reason.ESTOPPED, words
    refusal = _may_drive(sender, context)
    if refusal is not None or not context.pauses or sender.kind is Rank.LEAD:
        return refusal
    last = context.pauses[-1]
    why = f': "{last.why}"' if last.why else ""
    people = context.people
    by_lead = people.roles is None and any(pause.rank is Rank.LEAD for pause in context.pauses)
    who = "A lead" if people.leads or by_lead else "A person"
    return Reason.PAUSED, f"{car} is paused with the whole fleet ({last.by}{why}). {who} ends it with `fleet unpause`."


def _unmet(command: Command, needed: Needs, context: CommandContext) -> Refusal | None:
    """Return the first need that is not met; None if all are."""
    car, sender = context.car, command.sender
    refusal = _not_allowed(sender, context) if needed.allowed else None
    if refusal is not None:
        return refusal
    if needed.not_held and context.hold is not None:
        if sender.kind is Rank.COORDINATOR:
            words = f"{car} is on hold ({context.hold.by} stopped it). End the hold with `fleet resume {car}`."
            return Reason.HELD, words
        refusal = _hold_stays(sender, context)
        if refusal is not None:
            return refusal
    lease, now = context.lease, context.now
    if needed.lease and lease is not None and lease.refuses(sender, now, take=command.take):
        words = f"{car} is driven by {lease.holder.name} ({lease.holder.kind}) for another {lease.until - now:.1f} s."
        if sender.kind is lease.holder.kind and sender.kind in (Rank.PERSON, Rank.LEAD):
            return Reason.LEASED, f"{words} Wait, or take the car over (--take)."
        return Reason.LEASED, f"{words} Wait until the car is free."
    if needed.battery and context.battery:
        return Reason.BATTERY_LOW, context.battery
    if needed.link:
        refusal = _unreachable(context)
        if refusal is not None:
            return refusal
    if needed.manual and context.asked not in (None, Mode.MANUAL):
        # Where a plan runs, only a stop lasts: the coordinator would open the mode again after a change to manual.
        fix = f"`fleet mode {car} manual` (or `fleet stop {car}` if a plan runs)"
        return (
            Reason.WRONG_MODE,
            f"{car} ignores {command.verb} commands while in mode {context.asked}. First: {fix}.",
        )
    if needed.queue and context.queued >= MAX_QUEUED_COMMANDS:
        return Reason.QUEUE_FULL, f"{car} is busy: {context.queued} commands wait already. Try again in a second."
    return None


def _unreachable(context: CommandContext) -> Refusal | None:
    car = context.car
    if context.closing:
        return Reason.LINK_DOWN, f"the gateway of {car} is shutting down."
    if not context.link_open:
        return Reason.LINK_DOWN, f"{car} is unreachable: {context.link_reason}"
    return None
