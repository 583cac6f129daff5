"""Tests of `stop` through control, at random moments in every mode and load. The simulated car's motors are the judge.

tests/support/stops.py has the cases. tests/soak plays 200 moments of each, and checks the distribution.
"""

import random
from collections.abc import Callable
from itertools import product

import pytest
from msgspec.structs import replace

from gateway.control.commands import Action, AimServo, Drive, Led, SetMode, Signal, Stop
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.executor import FREE_ACTIONS
from gateway.drivers.yahboom.pacing import Gate, Pacing
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stops import cases, sequences, stop_choice
from gateway.sim.model.raspberry_pi import Transport
from gateway.sim.model.world import World
from schemas.commands import Verb
from schemas.words import Basis, Mode, Motion, Phase, Platform
from tests.support.stops import AVOIDANCE, CASES, ENDS_S, LONGEST_S, OPENS_S, RESTORED, Seen, StopTestCase, inside, play
from tests.support.virtual import Pair

MOMENTS = 4


def judge(seen: Seen) -> None:
    """Require that the motors are off for good within the announced worst case, and that the state says so."""
    # General stops do not end a mode. The mode is left when its readings have shown it, or when the platform is named.
    is_found = "found" in seen.case and "told-unknown" in seen.case
    limit_s = FOUND_S if is_found else seen.announced_s
    assert seen.motors_off_s <= limit_s, seen
    assert seen.settled_s <= limit_s + 0.002, seen  # the test looks every millisecond
    if "flickering" in seen.case and seen.phase is Phase.FAILED:
        return  # with an echo only now and then, two block gaps may never come
    assert (seen.motors, seen.basis) == ("off", seen.phase_basis), seen
    assert seen.motors_off_s <= seen.complete_s < ENDS_S, seen
    if can_show(seen):
        assert (seen.phase, seen.phase_basis) == (Phase.COMPLETE, Basis.SHOWN), seen
        assert seen.shown_s <= seen.complete_s, seen
    else:
        assert (seen.phase, seen.phase_basis) in ENDINGS, seen
        assert seen.phase is Phase.COMPLETE or any(words in seen.words for words in WHY_SENT), seen


ENDINGS = ((Phase.COMPLETE, Basis.SHOWN), (Phase.SENT, Basis.SENT))
WHY_SENT = [case.why("red") for case in cases.CASES if not case.shown_by]
WHY_SENT += [case.why("red") for case in (cases.WRONG_PLATFORM, cases.NOT_KNOWN)]
FOUND_S = 7.0
"""Maximum time until a car of an unknown platform is in mode 0 that was found in a mode that it reports."""


def can_show(seen: Seen) -> bool:
    """Return True for a car that shows each stop: its platform does, it has an echo, and its fan is off."""
    without = ("raspberry_pi", "stm32", "told-unknown", "no-echo", "flickering", "fan-on", "black")
    return not any(words in seen.case for words in without) and not seen.case.startswith("arduino-fan")


@pytest.mark.parametrize("case", CASES, ids=str)
def test_stop_at_any_moment_ends_within_announced_time(case: StopTestCase) -> None:
    for seed in range(MOMENTS):
        seen = play(case, seed)
        judge(seen)
        if AVOIDANCE not in seen.case:
            assert seen.motors_off_s <= seen.announced_s <= LONGEST_S, seen


@pytest.mark.parametrize("case", RESTORED, ids=str)
def test_stop_on_restored_link_stops_car(case: StopTestCase) -> None:
    for seed in range(MOMENTS):
        judge(play(case, seed))


def test_avoidance_without_echo_is_deaf_with_braked_motors() -> None:
    for seed in range(MOMENTS):
        pair = Pair(seed=seed, world=World.open_field(), start_s=2.0).ready()
        inside(AVOIDANCE)(pair, random.Random(seed))
        pair.ask(Stop(), verb="stop")
        asked_at = pair.now
        pair.run(20.0)
        assert pair.off_for_good_at() < asked_at
        assert pair.car.truth.mode is AVOIDANCE, "docs/reference/protocol.md#blocking-times: for ever"
        assert pair.control.driver.model.motors == "unknown", "it is not heard"


def test_recovery_of_car_that_wakes_for_one_millisecond() -> None:
    """The car has half a frame, and its ranging ends when only the `$` of recovery's `MODE00` has come.

    The `$` goes with the string of the half frame, and `4WD,MODE00#` stays. The car knows it neither as a MODE frame
    nor as any other frame, never clears it, and appends all later bytes. Its reports go on, so nobody notices. After a
    cut write, recovery sends the last color too, which clears the string.
    """
    pair = Pair(world=World.open_field(), start_s=2.0).ready()
    pair.until(lambda: not pair.car.truth.blocked, 3.0)
    pair.until(lambda: pair.car.truth.blocked, 3.0)
    wakes_at = pair.car.next_event()
    pair.cut = 9
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.run(wakes_at - 0.05 - 0.0016 - pair.now, linked=False)
    pair.connect()
    pair.run(20.0)
    assert pair.control.driver.model.motors == "off"
    assert pair.off_for_good_at() < pair.now


@pytest.mark.parametrize("interval_s", [0.1, 0.3, 0.8])
@pytest.mark.parametrize(
    "act", [lambda at: Led(1, 2, 3), lambda at: AimServo(90 + int(7 * at) % 40), lambda at: Signal(Verb.WHISTLE)],
    ids=["colors", "servo", "whistles"],
)  # fmt: skip
def test_stream_of_actions_puts_off_no_lost_stop(act: Callable[[float], Action], interval_s: float) -> None:
    """A color every 0.3 s once put off the repeats of a lost stop for ever, and the car drove on."""
    pair = Pair(world=World.room(), start_s=2.0).ready()
    pair.run(4.0)
    pair.ask(Drive(Motion.FORWARD, 60.0))
    pair.run(1.0)
    pair.lose_frames()
    pair.ask(Stop(), verb="stop", identity="stop")
    asked_at = pair.now
    pair.run(2.5)
    pair.pass_frames()
    while pair.now < asked_at + 30.0:
        pair.ask(act(pair.now))
        pair.run(interval_s)
    assert pair.off_for_good_at() < asked_at + 8.0
    ended = pair.last_of("stop")
    assert ended is not None
    assert (ended.phase, ended.basis) == (Phase.COMPLETE, Basis.SHOWN)


def test_single_actions_wait_for_no_evidence() -> None:
    pair = Pair(world=World.room(), start_s=2.0).ready()
    pair.run(4.0)
    pair.lose_frames()
    pair.ask(Stop(), verb="stop")
    pair.run(4.0)
    for number in range(FREE_ACTIONS):
        pair.ask(Led(1, 2, number), identity=f"led{number}")
        pair.run(0.3)
        assert Phase.SENT in pair.phases(f"led{number}")
        pair.run(0.7)


def test_recovery_keeps_color_that_is_set_during_it() -> None:
    pair = Pair(start_s=2.0).ready()
    pair.cut = 9
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.connect()
    pair.deaf_until = pair.now + 20.0
    pair.run(12.0)  # in the second try, which began with the color from before
    count = len(pair.sent)
    pair.ask(Led(255, 0, 7))
    pair.run(6.0)
    colors = [data for _, data in pair.sent[count:] if b"CLR" in data]
    assert set(colors) == {b"$4WD,CLR255,CLG0,CLB7#"}
    assert len(colors) == 2, "the command, and the recovery"


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
@pytest.mark.parametrize("world", [World.room, World.open_field], ids=["echo", "no-echo"])
def test_soft_stop_at_end_of_drive_is_in_time(platform: str, world: Callable[[], World]) -> None:
    """A soft stop takes 0.02 s, up to 1.0 s without an echo, and 1.1 s with a frame of ours in the buffer.

    The source is docs/reference/protocol.md#stops.
    """
    bound = 0.1 if world is World.room else 1.0 + 1.1 + 0.1
    for seed in range(MOMENTS):
        moments = random.Random(seed)
        pair = Pair(platform, seed=seed, world=world(), transport=Transport.TCP, start_s=2.0).ready()
        pair.run(moments.random())
        asked_at = pair.now
        pair.ask(Drive(Motion.FORWARD, 0.7), identity="drive")
        pair.run(6.0)
        assert pair.off_for_good_at() <= asked_at + 0.7 + bound, f"seed {seed}"
        phases, ended = pair.phases("drive"), pair.last_of("drive")
        assert phases[:3] == [Phase.ASKED, Phase.QUEUED, Phase.SENT]
        assert ended is not None
        assert (ended.phase, ended.basis) in ((Phase.SENT, Basis.SENT), (Phase.COMPLETE, Basis.SHOWN))
        assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", Basis.SENT), (
            "a soft stop shows nothing"
        )
        assert not any(b"MODE" in data for at, data in pair.sent if at > asked_at), (
            "a soft stop keeps the car in mode 0"
        )


def test_mode_never_opens_while_motors_are_on() -> None:
    for seed in range(40):
        moments = random.Random(seed)
        pair = Pair(seed=seed, world=moments.choice([World.room, World.open_field])(), start_s=2.0).ready()
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(2 * moments.random())
        pair.ask(SetMode(Mode.COLOR_LED), identity="mode")
        pair.until(lambda pair=pair: Phase.SENT in pair.phases("mode"), OPENS_S)
        assert pair.sent[-1][1] == b"$4WD,MODE41#"
        opened_at = pair.sent[-1][0]
        pair.until(lambda pair=pair: pair.car.truth.mode is Mode.COLOR_LED, 1.1)  # it may range once before
        pair.run(10.0)
        assert pair.off_for_good_at() < opened_at, f"seed {seed}: {pair.sent}"


# ---------------------------------------------------------------------- the choice, as a table


FLAGS = (True, False)


def situations() -> list[stop_choice.StopContext]:
    """Return all combinations of the inputs of the choice."""
    return [
        stop_choice.StopContext(
            parse_platform(platform), known, mode, contradicted, all_read, blocked, doubted=doubted, open_mode=open_mode
        )
        for platform, known, mode, contradicted, all_read, blocked, doubted, open_mode in product(
            Platform, FLAGS, (None, *Mode), FLAGS, FLAGS, FLAGS, FLAGS, FLAGS
        )
    ]


def certain(situation: stop_choice.StopContext) -> bool:
    """Return True if the car is known to be in mode 0, where it obeys general frames."""
    return situation.known and situation.mode is Mode.MANUAL and not situation.contradicted


def knows_modes(situation: stop_choice.StopContext) -> bool:
    """Return True if the car may get a named frame: its platform knows it, or its readings show an open mode."""
    return situation.open_mode or situation.profile.kind in (Platform.ARDUINO, Platform.STM32)


def is_doubtful(situation: stop_choice.StopContext) -> bool:
    """Return True if the car gets both kinds of stops."""
    return situation.doubted or situation.profile.kind in (Platform.RASPBERRY_PI, Platform.UNKNOWN)


# The first matching row counts (docs/reference/protocol.md#stops).
FULL: tuple[tuple[Callable[[stop_choice.StopContext], bool], sequences.StopSequence], ...] = (
    (lambda it: not knows_modes(it), sequences.GENERAL),
    (lambda it: is_doubtful(it) and not it.known, sequences.BOTH),
    (lambda it: is_doubtful(it) and certain(it), sequences.BOTH_MANUAL),
    (is_doubtful, sequences.BOTH),
    (lambda it: not it.known, sequences.RECOVERY),
    (lambda it: not certain(it), sequences.FULL_MODE),
    (lambda it: it.profile.kind is Platform.STM32, sequences.GENERAL),
    (lambda it: not it.has_read_all, sequences.FULL_BEHIND),
    (lambda it: True, sequences.FULL),
)


def test_stop_case_over_whole_input_product() -> None:
    everything = situations()
    assert len(everything) == 4 * 2 * 8 * 2 * 2 * 2 * 2 * 2
    for situation in everything:
        full = next(recipe for fits, recipe in FULL if fits(situation))
        assert stop_choice.full(situation) is full, situation
        if not knows_modes(situation):
            soft = sequences.GENERAL_SOFT
        else:
            soft = sequences.SOFT if certain(situation) and not is_doubtful(situation) else full
        assert stop_choice.soft(situation) is soft, situation
        assert stop_choice.recovery(situation).rank <= max(full.rank, sequences.RECOVERY.rank)


def test_stop_recipes_send_known_frames_only() -> None:
    for situation in situations():
        profile = parse_platform("arduino") if situation.open_mode else situation.profile
        for recipe in (
            stop_choice.full(situation),
            stop_choice.soft(situation),
            stop_choice.recovery(situation),
        ):
            for step in recipe.steps:
                assert profile.refusal(step.frame) is None, (situation, recipe)


def test_stop_recipes_end_alone_in_buffer() -> None:
    """The last frame comes 1.1 s after the frame before it, or waits until the car has read that frame."""
    for situation in situations():
        for recipe in (stop_choice.full(situation), stop_choice.soft(situation)):
            last = recipe.steps[-1]
            assert last.after_s >= REPEAT_INTERVAL_S - 1e-9 or last.gate is Gate.ALONE, recipe


def test_announced_time_is_never_less_than_waited() -> None:
    for each in situations():
        for ago_s in (0.0, 0.05, 0.3, 1.0, 2.0, 9.0):
            pacing = Pacing(each.profile, Learned())
            pacing.on_written(sequences.SOFT.steps[0].frame, 100.0 - ago_s)
            situation = replace(each, has_read_all=pacing.has_read_all(100.0), blocked=False)
            for recipe in (stop_choice.full(situation), stop_choice.soft(situation)):
                worst_s = stop_choice.worst_s(recipe, situation, pacing, 100.0)
                assert worst_s >= max(0.0, pacing.ready_at(recipe.steps[0].gate) - 100.0) + stop_choice.WIRE_S
                sure = situation.known and not (situation.contradicted or situation.doubted)
                possible = sure and situation.mode in situation.profile.modes
                assert worst_s <= LONGEST_S or situation.turn_s > 1.0 or not possible, (situation, recipe)
