"""May this command be carried out on this car now? One pure function from a picture of the car to a refusal or none.

From every state, stop and estop are let through.
"""

from dataclasses import dataclass
from typing import Final

from gateway.control.records import Act, ChangeSpeed, Command, Drive, Fan, Find, Kind, Reason, Resume, SetMode, Stop
from gateway.protocol.encode import General
from gateway.protocol.profile import Profile
from gateway.protocol.values import Mode, Motion

QUEUE_LIMIT: Final = 8
"""One-shots that may wait; more are refused."""


@dataclass(frozen=True, slots=True)
class Situation:
    """What the arbiter looks at."""

    car: str
    profile: Profile
    link_open: bool
    link_reason: str
    answering: bool
    """False once recovery has given up: nothing heard, motors unknown."""
    closing: bool
    asked: Mode | None
    """The mode the car is in, or is about to be in."""
    held_by: str | None
    fan: bool | None
    queued: int


Refusal = tuple[Reason, str]


def refuse(command: Command, situation: Situation) -> Refusal | None:
    """Why the command is refused, or None. The words name the car, the state, and what to do."""
    what = command.what
    if isinstance(what, Stop):
        return None
    if command.age_s > command.ttl_s:
        return Reason.STALE, f"{command.age_s:.1f} s old on arrival, at most {command.ttl_s:g} s is allowed: ask again"
    for rule in (_platform, _hold, _link, _mode, _queue):
        refusal = rule(command, situation)
        if refusal is not None:
            return refusal
    return None


def _platform(command: Command, situation: Situation) -> Refusal | None:
    what, profile = command.what, situation.profile
    words: str | None = None
    match what:
        case SetMode(mode):
            if mode is not Mode.MANUAL and mode not in profile.modes:
                known = ", ".join(sorted(profile.modes))
                words = f"a {profile.name} car does not know mode {mode}; it knows: {known}"
        case Act(frame):
            words = profile.refusal(frame)
        case ChangeSpeed(step):
            words = profile.refusal(General(Motion.STOP, speed=step))
        case Fan(on):
            words = profile.refusal(General(Motion.STOP, fan=True))
            if words is None and on is not None and situation.fan is None:
                words = (
                    f"whether {situation.car}'s fan runs is not known: only a toggle is possible (leave the state out)"
                )
        case Drive(motion):
            words = profile.refusal(General(motion))
        case _:
            pass
    return None if words is None else (Reason.UNSUPPORTED, words)


def _hold(command: Command, situation: Situation) -> Refusal | None:
    if command.sender.kind is not Kind.COORDINATOR:
        return None
    if isinstance(command.what, Resume):
        return Reason.HELD, "a coordinator may not resume a car: a person or a script does"
    if situation.held_by is None:
        return None
    ends = "a drive, mode or resume by a person or script ends it"
    return Reason.HELD, f"{situation.car} is on hold ({situation.held_by} stopped it): {ends}"


def _link(command: Command, situation: Situation) -> Refusal | None:
    if isinstance(command.what, Resume):
        return None
    if situation.closing:
        return Reason.LINK_DOWN, f"the gateway of {situation.car} is ending"
    if not situation.link_open:
        return Reason.LINK_DOWN, f"{situation.car} cannot be reached: {situation.link_reason}"
    if not situation.answering:
        return (
            Reason.LINK_DOWN,
            f"{situation.car} does not answer: no reading since its recovery; is it on, and the platform right?",
        )
    return None


def _mode(command: Command, situation: Situation) -> Refusal | None:
    needs_manual = isinstance(command.what, Act | ChangeSpeed | Fan | Find) or (
        isinstance(command.what, Drive) and command.what.motion is not Motion.STOP
    )
    if not needs_manual or situation.asked in (None, Mode.MANUAL):
        return None
    # The stop first: under a coordinator, which would bring a mode back, it is what helps.
    helps = "stop it, or bring it to mode manual first"
    return Reason.WRONG_MODE, f"{situation.car} is in mode {situation.asked}, where it ignores this: {helps}"


def _queue(command: Command, situation: Situation) -> Refusal | None:
    if isinstance(command.what, Act | ChangeSpeed | Fan | Find) and situation.queued >= QUEUE_LIMIT:
        return Reason.QUEUE_FULL, f"{situation.queued} commands wait for {situation.car} already: ask again in a second"
    return None
