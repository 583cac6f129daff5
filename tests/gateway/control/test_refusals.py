"""Tests of refusals on all combinations of their inputs. Stop always wins. Nobody moves a car without permission."""

import functools
import itertools
from collections.abc import Iterator

import pytest
from msgspec.structs import replace

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    Led,
    Lend,
    MoveArm,
    MoveServo,
    PartAction,
    Pause,
    Resume,
    SetLight,
    SetMode,
    Signal,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.refusals import MAX_QUEUED_COMMANDS, TABLE, CommandContext, Refusal, needs, refuse
from schemas.commands import Verb
from schemas.rights import Authority, Estop, Hold, LeaseState, Sender
from schemas.words import Light, Mode, Motion, Rank, Reason, ServoAction, SpeedStep
from tests.support.message_length import MAX_LINES, count_lines

NOW = 100.0
WHATS: list[Action] = [
    Stop(),
    EmergencyStop(),
    EmergencyStop("smoke", fleet_wide=True),
    Resume(),
    Resume(("e1",)),
    Resume(("other",)),
    Resume(("over",)),
    TakeLease(),
    TakeLease(release=True),
    Drive(Motion.FORWARD),
    Drive(Motion.STOP),
    SetMode(Mode.TRACKING),
    SetMode(Mode.MANUAL),
    SetLight(Light.RED),
    Signal(Verb.WHISTLE),
    MoveServo(ServoAction.FRONT_LEFT),
    Led(1, 2, 3),
    AimServo(90),
    MoveArm((0,) * 6),
    ChangeSpeed(SpeedStep.UP),
    Fan(),
    Fan(on=True),
    Find(),
]
DIRECTIONS: list[Action] = [Pause("listen"), Unpause(), Lend("bob", 60.0), EndLoan()]
"""Commands that test_people.py tests, with leads and pauses."""
MOVES = (Drive, SetMode)
"""Commands that move the car."""
KINDS = [Rank.PERSON, Rank.SCRIPT, Rank.COORDINATOR]
SENDERS = [Sender("ann", kind) for kind in KINDS]
LEASES = [
    None,
    *(LeaseState(Sender("bob", kind), NOW + 1.0) for kind in KINDS),
]
MODES = [None, Mode.MANUAL, Mode.TRACKING, Mode.COLOR_LED]
RANK = list(reversed(KINDS))
ESTOP = Estop("e1", "eve", "smoke", 1, fleet_wide=False)


@functools.cache
def situations() -> tuple[CommandContext, ...]:
    """Return all states, made once, because each of 69 tests goes through them twice."""
    return tuple(_situations())


def _situations() -> Iterator[CommandContext]:
    """Yield 2,048 states: link, closing, hold, e-stop, lease, battery, queue, mode, supported or not."""
    for (
        (link, closing, held, estopped, lease, battery, queued),
        asked,
        unsupported,
    ) in itertools.product(
        itertools.product(
            (True, False),
            (True, False),
            (None, Hold("mia", 1)),
            ((), (ESTOP,)),
            LEASES,
            ("", "flat"),
            (0, 8),
        ),
        MODES,
        (None, "red cars do not know it"),
    ):
        yield CommandContext(
            car="red",
            now=NOW,
            link_open=link,
            link_reason="gone",
            closing=closing,
            asked=asked,
            authority=Authority(hold=held, estops=estopped, lease=lease),
            ended=("over",),
            battery=battery,
            queued=queued,
            unsupported=unsupported,
        )


@pytest.mark.parametrize("sender", SENDERS, ids=lambda sender: sender.kind)
@pytest.mark.parametrize("what", WHATS, ids=repr)
def test_every_command_in_every_state(what: Action, sender: Sender) -> None:
    found: set[Refusal | None] = set()
    for take in (False, True):
        command = Command("c", "verb", sender, what, take=take)
        for at in situations():
            refusal = refuse(command, at)
            found.add(refusal)
            if refusal is not None:
                assert at.car in refusal[1] or refusal[0] in (Reason.UNSUPPORTED, Reason.HELD, Reason.BATTERY_LOW)
            _check(command, at, None if refusal is None else refusal[0])
    printed = ["fleet: red: refused: {1} [{0}]".format(*each) for each in found if each]
    assert [text for text in printed if count_lines(text) > MAX_LINES] == []
    seen = {each and each[0] for each in found}
    if isinstance(what, Drive) and what.motion is not Motion.STOP:
        every = {
            None,
            *(
                Reason.UNSUPPORTED,
                Reason.ESTOPPED,
                Reason.LEASED,
                Reason.BATTERY_LOW,
                Reason.LINK_DOWN,
                Reason.WRONG_MODE,
            ),
        }
        assert seen == (every | {Reason.HELD} if sender.kind is Rank.COORDINATOR else every)


def _check(command: Command, at: CommandContext, reason: Reason | None) -> None:
    """Require the rules of refusals, written in another way."""
    what, kind = command.what, command.sender.kind
    if isinstance(what, Stop | EmergencyStop):
        assert reason is None, "stop wins from every state"
        return
    if at.unsupported is not None:
        assert reason is Reason.UNSUPPORTED
        return
    if isinstance(what, Resume):
        in_force = what.ids == ("e1",) and bool(at.authority.estops)
        allowed = kind is not Rank.COORDINATOR and (not what.ids or what.ids == ("over",) or in_force)
        assert (reason is None) == allowed
        return
    if what == TakeLease(release=True):
        assert reason is None
        return
    if reason is not None:
        return
    assert not at.authority.estops, "an e-stopped car obeys nothing"
    assert not (at.authority.hold and kind is Rank.COORDINATOR), "no coordinator's command moves a held car"
    if not isinstance(what, TakeLease):
        assert at.link_open
        assert not at.closing
    moves = isinstance(what, MOVES) or (isinstance(what, PartAction) and what.needs_lease)
    if (moves or isinstance(what, TakeLease)) and at.authority.lease is not None:
        mine, theirs = RANK.index(kind), RANK.index(at.authority.lease.holder.kind)
        assert mine > theirs or (mine == theirs and command.take and kind is Rank.PERSON)
    if at.battery:
        assert not isinstance(what, Drive) or what.motion is Motion.STOP
        assert not isinstance(what, SetMode) or what.mode is Mode.MANUAL
    releases = isinstance(what, Drive) and what.motion is Motion.STOP
    if not isinstance(what, SetMode | TakeLease) and not releases:
        assert at.asked in (None, Mode.MANUAL), "the car would ignore it"
    if isinstance(what, PartAction | Find):
        assert at.queued < MAX_QUEUED_COMMANDS


def test_actions_that_move_parts_need_lease() -> None:
    parts = [what for what in WHATS if isinstance(what, PartAction)]
    without = {type(what) for what in parts if not what.needs_lease}
    assert without == {Led, SetLight, Signal}
    assert {type(what) for what in parts} - without == {MoveServo, AimServo, MoveArm, ChangeSpeed, Fan}


def test_table_has_every_command() -> None:
    others = {type(what) for what in (*WHATS, *DIRECTIONS) if not isinstance(what, PartAction)}
    assert others == set(TABLE)
    for what in (*WHATS, *DIRECTIONS):
        assert needs(what)


@pytest.mark.parametrize(
    "what", [what for what in (*WHATS, *DIRECTIONS) if not isinstance(what, Stop | EmergencyStop | Pause)], ids=repr
)
def test_late_command_is_stale_but_never_a_stop(what: Action) -> None:
    calm = replace(
        situations()[0],
        asked=Mode.MANUAL,
        closing=False,
    )
    late = Command("c", "verb", Sender("ann"), what, age_s=2.1, ttl_s=2.0)
    refusal = refuse(late, calm)
    assert refusal is not None
    assert refusal[0] is Reason.STALE
    for stop in (Stop(), EmergencyStop(), Pause()):
        assert refuse(Command("c", "stop", Sender("ann", Rank.PERSON), stop, age_s=1e9, ttl_s=2.0), calm) is None


@pytest.mark.parametrize(
    ("age_s", "refused"),
    [(-1e12, True), (-3600.0, True), (-5.1, True), (-4.9, False), (0.0, False), (2.0, False), (3600.0, True)],
)
@pytest.mark.parametrize("what", [*WHATS, *DIRECTIONS], ids=repr)
def test_far_timestamp_is_refused_but_stop_ignores_clock(what: Action, age_s: float, *, refused: bool) -> None:
    calm = replace(situations()[0], asked=Mode.MANUAL, closing=False)
    refusal = refuse(Command("c", "verb", Sender("ann", Rank.PERSON), what, age_s=age_s, ttl_s=2.0), calm)
    is_stale = refusal is not None and refusal[0] is Reason.STALE
    assert is_stale is (refused and not isinstance(what, Stop | EmergencyStop | Pause))
