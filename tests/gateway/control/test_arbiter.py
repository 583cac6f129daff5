"""Tests of the arbiter on all combinations of its inputs. Stop always wins. Nobody moves a car without permission."""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import replace

import pytest

from gateway.control.arbiter import MAX_QUEUED_COMMANDS, TABLE, CommandContext, Refusal, needs, refuse
from gateway.control.commands import (
    Action,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    Lend,
    OneShot,
    Pause,
    Resume,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.protocol.frames import ArmSet, ColorLed, General, Ptz
from gateway.protocol.platforms import parse_platform
from schemas.authority import Authority, Estop, Hold, LeaseState, Sender
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
    OneShot(General(Motion.STOP, light=Light.RED)),
    OneShot(General(Motion.STOP, whistle=True)),
    OneShot(General(Motion.STOP, servo=ServoAction.FRONT_LEFT)),
    OneShot(ColorLed(1, 2, 3)),
    OneShot(Ptz(90)),
    OneShot(ArmSet((0,) * 6)),
    ChangeSpeed(SpeedStep.UP),
    Fan(),
    Fan(on=True),
    Find(),
]
DIRECTIONS: list[Action] = [Pause("listen"), Unpause(), Lend("bob", 60.0), EndLoan()]
"""Commands that test_people.py tests, with leads and pauses."""
MOVES = (Drive, SetMode, ChangeSpeed, Fan)
"""Commands that move the car or change how it moves. These, servo and arm need the lease."""
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
    """Yield 4,096 states: link, closing, hold, e-stop, lease, battery, queue, mode, platform."""
    for (
        (link, closing, held, estopped, lease, battery, queued),
        asked,
        platform,
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
        ("arduino", "raspberry_pi", "unknown", "stm32+arm"),
    ):
        yield CommandContext(
            car="red",
            profile=PROFILES[platform],
            now=NOW,
            link_open=link,
            link_reason="gone",
            closing=closing,
            asked=asked,
            authority=Authority(hold=held, estops=estopped, lease=lease),
            ended=("over",),
            battery=battery,
            fan=None,
            queued=queued,
        )


PROFILES = {name: parse_platform(name) for name in ("arduino", "raspberry_pi", "unknown", "stm32+arm")}


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
        every = {None, *(Reason.ESTOPPED, Reason.LEASED, Reason.BATTERY_LOW, Reason.LINK_DOWN, Reason.WRONG_MODE)}
        assert seen == (every | {Reason.HELD} if sender.kind is Rank.COORDINATOR else every)


def _check(command: Command, at: CommandContext, reason: Reason | None) -> None:
    """Require the rules of the arbiter, written in another way."""
    what, kind = command.what, command.sender.kind
    if isinstance(what, Stop | EmergencyStop):
        assert reason is None, "stop wins from every state"
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
    moves = isinstance(what, MOVES) or (isinstance(what, OneShot) and _turns(what))
    if (moves or isinstance(what, TakeLease)) and at.authority.lease is not None:
        mine, theirs = RANK.index(kind), RANK.index(at.authority.lease.holder.kind)
        assert mine > theirs or (mine == theirs and command.take and kind is Rank.PERSON)
    if at.battery:
        assert not isinstance(what, Drive) or what.motion is Motion.STOP
        assert not isinstance(what, SetMode) or what.mode is Mode.MANUAL
    releases = isinstance(what, Drive) and what.motion is Motion.STOP
    if not isinstance(what, SetMode | TakeLease) and not releases:
        assert at.asked in (None, Mode.MANUAL), "the car would ignore it"
    if isinstance(what, OneShot | ChangeSpeed | Fan | Find):
        assert at.queued < MAX_QUEUED_COMMANDS


def _turns(act: OneShot) -> bool:
    return isinstance(act.frame, Ptz | ArmSet) or (isinstance(act.frame, General) and act.frame.servo is not None)


def test_the_table_has_every_command() -> None:
    others = {type(what) for what in (*WHATS, *DIRECTIONS)} - {OneShot, ChangeSpeed, Fan}
    assert others == set(TABLE)
    for what in (*WHATS, *DIRECTIONS):
        assert needs(what)


@pytest.mark.parametrize(
    "what", [what for what in (*WHATS, *DIRECTIONS) if not isinstance(what, Stop | EmergencyStop | Pause)], ids=repr
)
def test_what_came_too_late_is_stale_but_a_stop_never_is(what: Action) -> None:
    calm = replace(
        situations()[0],
        profile=PROFILES["stm32+arm"],
        asked=Mode.MANUAL,
        closing=False,
        fan=True,
    )
    late = Command("c", "verb", Sender("ann"), what, age_s=2.1, ttl_s=2.0)
    refusal = refuse(late, calm)
    assert refusal is not None
    assert refusal[0] is Reason.STALE
    for stop in (Stop(), EmergencyStop(), Pause()):
        assert refuse(Command("c", "stop", Sender("ann", Rank.PERSON), stop, age_s=1e9, ttl_s=2.0), calm) is None


@pytest.mark.parametrize(
    ("platform", "speed", "step", "limit", "refused"),
    [
        ("arduino", 150.0, SpeedStep.UP, 1.0, False),
        ("arduino", 150.0, SpeedStep.UP, 0.78, True),
        ("arduino", 150.0, SpeedStep.UP, 0.79, False),
        ("arduino", 150.0, SpeedStep.DOWN, 0.1, False),
        ("arduino", 50.0, SpeedStep.DOWN, 0.3, True),  # docs/reference/protocol.md#platforms: that step goes up, to 100
        ("raspberry_pi", 50.0, SpeedStep.UP, 0.6, True),
    ],
)
def test_no_step_beyond_the_speed_that_is_allowed(
    platform: str, speed: float, step: SpeedStep, limit: float, refused: bool
) -> None:
    calm = replace(situations()[0], profile=PROFILES[platform], asked=Mode.MANUAL, closing=False)
    refusal = refuse(
        Command("c", "speed", Sender("ann"), ChangeSpeed(step)), replace(calm, speed=speed, speed_max=limit)
    )
    assert (refusal is not None) is refused
    if refusal is not None:
        assert refusal[0] is Reason.UNSUPPORTED
        assert f"Its maximum is {limit:.0%}" in refusal[1]


@pytest.mark.parametrize(
    ("age_s", "refused"),
    [(-1e12, True), (-3600.0, True), (-5.1, True), (-4.9, False), (0.0, False), (2.0, False), (3600.0, True)],
)
@pytest.mark.parametrize("what", [*WHATS, *DIRECTIONS], ids=repr)
def test_a_time_far_from_now_is_refused_but_a_stop_looks_at_no_clock(
    what: Action, age_s: float, *, refused: bool
) -> None:
    calm = replace(situations()[0], profile=PROFILES["stm32+arm"], asked=Mode.MANUAL, closing=False, fan=True)
    refusal = refuse(Command("c", "verb", Sender("ann", Rank.PERSON), what, age_s=age_s, ttl_s=2.0), calm)
    is_stale = refusal is not None and refusal[0] is Reason.STALE
    assert is_stale is (refused and not isinstance(what, Stop | EmergencyStop | Pause))
