"""Decides whether a command may be carried out now: a table of what each command needs, and a rule for each need.

Pure: it gets the context of the car and returns a refusal or None. A stop or e-stop is never refused here. Elsewhere
are the refusals of the bus, of commands that are too many, of the parser, of a command that it cannot read or whose
sender is not proven, and of the controller, of a command that came before, and of a stop that it cannot send.
"""

from typing import Final

from msgspec import Struct

from gateway.control.commands import (
    Action,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Find,
    Lend,
    PartAction,
    Pause,
    Resume,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from schemas.keys import name_of
from schemas.limits import STREAM_SILENCE_S
from schemas.rights import Authority, Bar, Denial, Estop, FleetPause, LeaseState, Loan, Right, Sender
from schemas.suggestion import did_you_mean
from schemas.words import Mode, Motion, Rank, Reason

MAX_QUEUED_COMMANDS: Final = 8
"""Maximum actions on parts of the car in the queue. Further ones are refused."""
MAX_AHEAD_S: Final = 5.0
"""Maximum time by which `asked` may lie in the future. The clocks of computers that use NTP differ by less."""
CLOCK_DOUBT_S: Final = 30.0
"""If a command is later than this, a wrong clock is a more likely cause than a slow network."""
AFTER_SLEEP_S: Final = 2.0
"""For this long after a sleep of the computer, a command without `asked` may be from before the sleep."""


class CommandContext(Struct, frozen=True):
    """The state of car and gateway on which the decision about a command depends."""

    car: str
    now: float
    link_open: bool
    link_reason: str
    closing: bool
    asked: Mode | None
    """The commanded mode, even if the car is not in it yet. Manual if the readings show that the car has left it."""
    authority: Authority
    ended: tuple[str, ...]
    """Ids of ended e-stops."""
    battery: str
    """Why the battery allows no new drive. Empty if it allows one."""
    queued: int
    unsupported: str | None = None
    """Why this car cannot do this at all, as its driver says, or None if it can."""
    loan_until: float = 0.0
    """When the loan ends, s, monotonic."""
    slept_at: float = float("-inf")
    """When the last sleep of the computer was noticed."""
    is_halted: bool = False
    """True if the sender's drives are refused until it pauses, because the car was stopped."""
    held: tuple[Motion, Sender] | None = None
    """The motion that the car holds, and who holds it."""
    busy_s: float = 0.0
    """How long a motion would have to wait for the car, as far as that is known."""


class Needs(Struct, frozen=True):
    """The conditions for a command."""

    right: Right | None = Right.ACT
    """The right that the sender needs, or None if everybody may."""
    battery: bool = False
    link: bool = True
    manual: bool = False
    """The car must be in mode 0; it ignores the command in other modes."""
    queue: bool = False

    @property
    def lease(self) -> bool:
        """True if the sender needs the lease."""
        return self.right is Right.MOVE


_ANYTIME: Final = Needs(right=None, link=False)
_MOVES: Final = Needs(Right.MOVE, battery=True, manual=True)
_ACTS: Final = Needs(manual=True, queue=True)
_ADJUSTS: Final = Needs(Right.MOVE, manual=True, queue=True)

RELEASE: Final = Needs(Right.MOVE)
"""Needs of a drive with motion stop: it moves nothing, so it needs neither battery nor mode 0."""
CLOSE: Final = Needs(Right.MOVE)
"""Needs of mode manual: it stops the car, so it needs no battery."""
TABLE: Final[dict[type[Action], Needs]] = {
    Stop: _ANYTIME,
    EmergencyStop: _ANYTIME,
    Resume: _ANYTIME,
    Pause: Needs(Right.PAUSE, link=False),
    Unpause: Needs(Right.UNPAUSE, link=False),
    Lend: Needs(Right.LEND, link=False),
    EndLoan: Needs(Right.END_LOAN, link=False),
    TakeLease: Needs(Right.MOVE, link=False),
    Drive: _MOVES,
    SetMode: Needs(Right.MOVE, battery=True),
    Find: _ACTS,
}
"""Needs of each action that is not a `PartAction`. Who may end which e-stop or hold is in `Authority.denies_resume`."""

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
        case PartAction():
            return _ADJUSTS if what.needs_lease else _ACTS
        case _:
            return TABLE[type(what)]


def refuse(command: Command, context: CommandContext) -> Refusal | None:
    """Return why the command is refused, or None if it is not. The text tells the cause, and mostly what to do."""
    what, sender = command.what, command.sender
    if isinstance(what, Stop | EmergencyStop):
        return None
    # A late pause is carried out, as a late stop is: it is better than none.
    if not isinstance(what, Pause) and (words := _out_of_time(command, context)) is not None:
        return Reason.STALE, words
    if context.unsupported is not None:
        return Reason.UNSUPPORTED, context.unsupported
    if isinstance(what, Resume):
        return _resume(what, sender, context)
    if (refusal := _unmet(command, needs(what), context)) is not None:
        return refusal
    if isinstance(what, Lend):
        return _unknown_borrower(what.to, context)
    return _drive(command, what, context) if isinstance(what, Drive) else None


def _out_of_time(command: Command, context: CommandContext) -> str | None:
    """Return why the command is too old, or too far in the future. None if it is not.

    A command of unknown age is refused only just after a sleep of the computer.
    """
    age_s, clocks = command.age_s, f"Set the clock of its computer, or of the one that runs {context.car}'s gateway."
    if age_s is None:
        if context.now < context.slept_at + AFTER_SLEEP_S:
            return "the computer has just slept, and the command may be from before. Send it again with `asked`."
        return None
    if age_s < -MAX_AHEAD_S:
        limit = f"maximum {MAX_AHEAD_S:g} s"
        return f"the command was asked {-age_s:.0f} s in the future by its sender's clock ({limit}). {clocks}"
    if age_s <= command.ttl_s:
        return None
    words = f"the command arrived {age_s:.1f} s late (maximum {command.ttl_s:g} s). Send it again."
    return words if age_s < CLOCK_DOUBT_S else f"{words} If that does not help: {clocks.lower()[0]}{clocks[1:]}"


def _drive(command: Command, drive: Drive, context: CommandContext) -> Refusal | None:
    """Return why this drive does not begin or continue. None if it does."""
    car = context.car
    if context.is_halted:
        words = f"{car} was just stopped. Send no drive command for {STREAM_SILENCE_S:g} s, then drive again."
        return Reason.HELD, words
    if drive.motion is Motion.STOP:
        return None
    # Suppose the hub stood still while somebody held a key, and the car has stopped. When the hub continues, it
    # delivers the newest samples of that press, which must not start the car again.
    if drive.continues and context.held != (drive.motion, command.sender):
        return Reason.LAPSED, f"{car} has stopped, because no drive arrived for too long. Press again."
    # A drive outside a stream waits instead, and its duration begins when its frame is written.
    if command.streamed and drive.duration_s <= context.busy_s:
        busy = f"{car} is busy for another {context.busy_s:.1f} s"
        return Reason.EXPIRED, f"{busy}. After that, the next samples of this stream drive it."
    return None


def _unknown_borrower(person: str, context: CommandContext) -> Refusal | None:
    roles = context.authority.people.roles
    if roles is None or person in roles:
        return None
    near = did_you_mean(person, roles) or f"There are: {', '.join(sorted(roles))}."
    return Reason.BAD_VALUE, f'`people:` in the fleet file lists no "{person}". {near}'


def _resume(resume: Resume, sender: Sender, context: CommandContext) -> Refusal | None:
    car, authority = context.car, context.authority
    in_force = [estop.id for estop in authority.estops]
    unknown = resume.ids and not set(resume.ids) & {*in_force, *context.ended}
    if unknown and sender.kind is not Rank.COORDINATOR:
        there = f"In force: {', '.join(in_force)}." if in_force else "None is in force."
        return Reason.BAD_VALUE, f"{car} has no e-stop {', '.join(resume.ids)}. {there}"
    denial = authority.denies_resume(sender, resume.ids, every=resume.all)
    return None if denial is None else _refusal(denial, sender, context, Right.RESUME)


def _unmet(command: Command, needed: Needs, context: CommandContext) -> Refusal | None:
    """Return the refusal for the first need that is not met, or None if all needs are met."""
    car, right = context.car, needed.right
    if right is not None:
        if right is Right.MOVE and command.take:
            right = Right.TAKE
        denial = context.authority.denies(command.sender, right)
        if denial is not None:
            return _refusal(denial, command.sender, context, right)
    if needed.battery and context.battery:
        return Reason.BATTERY_LOW, context.battery
    if needed.link:
        refusal = _unreachable(context)
        if refusal is not None:
            return refusal
    if needed.manual and context.asked not in (None, Mode.MANUAL):
        # If a plan is running, the coordinator opens the mode again after a change to manual, but not after a stop.
        fix = f"`fleet mode {car} manual` (or `fleet stop {car}` if a plan runs)"
        return (
            Reason.WRONG_MODE,
            f"{car} ignores {command.verb} commands while in mode {context.asked}. First: {fix}.",
        )
    if needed.queue and context.queued >= MAX_QUEUED_COMMANDS:
        return Reason.QUEUE_FULL, f"{car} is busy: {context.queued} commands wait already. Try again in a second."
    return None


# ---------------------------------------------------------------------- words


_DEEDS: Final = {
    Right.PAUSE: "pause the fleet",
    Right.UNPAUSE: "end the pause",
    Right.LEND: "lend {car}",
    Right.END_LOAN: "end the loan of {car}",
}
"""The actions that some rights allow, in the words of a refusal."""


def _refusal(denial: Denial, sender: Sender, context: CommandContext, right: Right | None = None) -> Refusal:
    """Return the refusal for a person at a terminal: what prevents the command, and what to do."""
    return denial.reason, _words(denial, sender, context, right)


def _words(denial: Denial, sender: Sender, context: CommandContext, right: Right | None) -> str:
    car, person, people = context.car, sender.person, context.authority.people
    deed = "" if right is None else _DEEDS.get(right, "").format(car=car)
    mark = denial.mark
    why = f': "{mark.why}"' if isinstance(mark, Estop | FleetPause) and mark.why else ""
    by = name_of(mark.by) if mark is not None else ""
    match denial.bar:
        case Bar.NOT_A_LEAD:
            return f"{person} may not {deed}: only a lead may ({', '.join(people.leads)})."
        case Bar.NOT_A_PERSON:
            return f'a {sender.kind} may not {deed}: only a person may. Send kind "person".'
        case Bar.UNLISTED:
            return (
                f"{person} may watch and stop {car}, nothing else: `people:` in the fleet file does not list "
                f"{person}. Say who you are with `--as NAME` or FLEET_AS."
            )
        case Bar.OTHER_CAR:
            who = f"{', '.join(people.leads)} can lend it" if people.leads else "Somebody who drives it can lend it"
            words = f"{person} may not drive {car}: `people:` in the fleet file gives {person} other cars."
            return f"{words} {who}: `fleet lend {car} --to {person} --for 10m`."
        case Bar.LENT if isinstance(mark, Loan):
            left = f"{context.loan_until - context.now:.0f} s"
            return f"{car} is lent to {mark.to} for another {left}. {by} ends that with `fleet lend {car} --end`."
        case Bar.ESTOPPED:
            return f"{car} is emergency-stopped ({by}{why}). Release it with `fleet resume {car} --estops`."
        case Bar.LEADS_ESTOP:
            return f"{car} stays emergency-stopped: {by} stopped it{why}, and {_only_leads(context)}"
        case Bar.PAUSED:
            by_lead = people.roles is None and any(pause.rank is Rank.LEAD for pause in context.authority.pauses)
            who = "A lead" if people.leads or by_lead else "A person"
            return f"{car} is paused with the whole fleet ({by}{why}). {who} ends it with `fleet unpause`."
        case Bar.LEADS_PAUSE:
            return f"{car} stays paused: {by} paused the fleet, and {_only_leads(context)}"
        case Bar.ON_HOLD if right is Right.RESUME:
            return f"{car} stays on hold: only a person or a script may resume it, not the coordinator."
        case Bar.ON_HOLD:
            return f"{car} is on hold ({by} stopped it). End the hold with `fleet resume {car}`."
        case Bar.LEADS_HOLD:
            return f"{car} is on hold: {by} stopped it, and {_only_leads(context)}"
        case Bar.LEASED if isinstance(mark, LeaseState):
            holder, left_s = mark.holder, mark.until - context.now
            words = f"{car} is driven by {holder.told_beside(sender)} ({holder.kind}) for another {left_s:.1f} s."
            if sender.kind is holder.kind and sender.kind in (Rank.PERSON, Rank.LEAD):
                return f"{words} Wait, or take the car over (--take)."
            return f"{words} Wait until the car is free."
        case _:
            raise AssertionError(denial)


def _only_leads(context: CommandContext) -> str:
    """Return the rule that only a lead may end what a lead began, and who the leads are."""
    rule, leads = "only a lead may end what a lead began", context.authority.people.leads
    if leads:
        return f"{rule} ({', '.join(leads)})."
    where = "`people:` of the fleet file, or with `--person NAME:lead`"
    return f"{rule}. The gateway of {context.car} knows no leads: name them in {where}."


def _unreachable(context: CommandContext) -> Refusal | None:
    car = context.car
    if context.closing:
        return Reason.LINK_DOWN, f"the gateway of {car} is shutting down."
    if not context.link_open:
        return Reason.LINK_DOWN, f"{car} is unreachable: {context.link_reason}"
    return None
