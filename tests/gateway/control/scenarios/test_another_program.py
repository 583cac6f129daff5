"""The gateway learns another program on the same link again, whatever it has learned of the car before."""

import json
import random
from typing import Any

import pytest

from gateway.control.commands import Drive, SetMode, Stop
from gateway.drivers.yahboom.estimate.learned import REACTED, Learned
from gateway.drivers.yahboom.estimate.platform import OTHER_PROGRAM_FRAMES
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.sim.model.traits import CarTraits
from schemas.platform_name import parse_option
from schemas.words import Basis, Mode, Motion, Phase, Shows
from tests.support.controls import control
from tests.support.virtual import Pair

KEPT: dict[str, Any] = {
    "echo_s": [1.254] * 9,
    "no_echo_s": [],
    "shows": "yes",
    "doubted": False,
    "reporting": ["manual"],
    "blocks_s": {},
}


def met(kept_s: float, traits: CarTraits) -> Pair:
    """Connect a car of which another rhythm is kept, that showed its stops."""
    pair = Pair(start_s=2.0, traits=traits)
    pair.control = control(parse_platform("arduino"), learned=Learned.restore(KEPT | {"echo_s": [kept_s] * 9}))
    pair.connect()
    return pair


@pytest.mark.parametrize(
    ("kept_s", "traits"),
    [
        (1.254, CarTraits(interval_s=3.0)),
        (1.254, CarTraits(interval_s=2.2)),
        (1.254, CarTraits(interval_s=0.71)),
        (1.254, CarTraits(interval_s=0.3)),  # with its block, 1.3 s: as if it were the rhythm of before
        (3.0, CarTraits()),
        (0.5, CarTraits(interval_s=2.2)),
        (1.254, CarTraits(interval_s=1.0, timer=True, close_s=0.0)),
    ],
    ids=str,
)
def test_rhythm_of_another_program_is_relearned_during_stops(kept_s: float, traits: CarTraits) -> None:
    pair = met(kept_s, traits)
    pair.run(60.0)
    learned = pair.control.driver.model.learned
    assert abs(learned.echo.median_s - traits.interval_s) < 0.1
    assert not learned.doubted
    assert pair.control.driver.model.motors == "off"
    pair.ask(Stop(), identity="it")
    pair.run(25.0)
    last = pair.last_of("it")
    assert last is not None
    assert last.basis in ("sent", "shown")
    closes = [at for at, data in pair.sent if b"MODE00" in data and at > pair.now - 20.0]
    assert len(closes) <= 6, "it is not stopped for ever"


def test_car_shows_stops_again_when_wire_is_whole() -> None:
    pair = Pair(start_s=2.0)
    feed = pair.car.feed
    pair.car.feed = lambda *_: None  # type: ignore[method-assign]
    pair.connect()
    pair.until(lambda: pair.control.driver.model.learned.shows is Shows.NO, 60.0)
    pair.car.feed = feed  # type: ignore[method-assign]
    for number in range(REACTED + 1):
        pair.ask(Stop(), identity=str(number))
        pair.run(15.0)
    assert pair.control.driver.model.learned.shows is Shows.YES
    last = pair.last_of(str(REACTED))
    assert last is not None
    assert last.basis == "shown"


@pytest.mark.parametrize(
    "damage",
    [
        {"blocks_s": {"mode_close": 40.0}},
        {"blocks_s": {"mode_close": float("nan")}},
        {"blocks_s": {"mode_close": -1.0}},
        {"echo_s": [40.0]},
        {"no_echo_s": [float("inf")]},
        {"opened_as": "arduino+head=4,D"},
    ],
    ids=str,
)
def test_numbers_of_no_car_are_not_restored(damage: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        Learned.restore(json.loads(json.dumps(KEPT | damage)))


def test_drive_right_after_connect_is_not_called_ignored() -> None:
    pair = Pair(start_s=2.0)
    pair.connect()
    pair.until(lambda: pair.control.is_free(pair.now), 20.0)
    for number in range(4):
        pair.ask(Drive(Motion.FORWARD, 1.0), identity=str(number))
        pair.run(2.5)
        last = pair.last_of(str(number))
        assert last is not None
        assert "may not have moved" not in last.words


def test_repeats_of_a_stop_give_way_at_once() -> None:
    """A full stop that repeats the end of a drive delays the next drive by the block of its `MODE00` at most."""
    for wait in range(20):
        pair = Pair(start_s=2.0)
        pair.connect()
        pair.until(lambda pair=pair: pair.control.is_free(pair.now), 20.0)
        pair.ask(Drive(Motion.FORWARD, 0.5))
        pair.run(1.5 + wait * 0.1)
        closed_at = max((at for at, data in pair.sent if b"MODE00" in data), default=float("-inf"))
        asked_at = pair.now
        pair.ask(Drive(Motion.BACK, 0.5))
        pair.until(lambda pair=pair: pair.sent[-1][1].startswith(b"$2"), 2.0)
        after = [data for at, data in pair.sent if at > asked_at + 0.01]
        assert len(after) <= 1, "no frame of a repeat goes before it"
        assert pair.now <= max(asked_at, closed_at + 1.0) + 0.3


def test_report_delayed_by_mode_00_is_no_rhythm() -> None:
    """The drive takes the place of the stop, so its `MODE00` is not judged. The car blocks all the same."""
    for seed in range(80):
        moments = random.Random(seed)
        pair = Pair(start_s=moments.uniform(0.0, 4.0), traits=CarTraits(interval_s=2.2), seed=seed)
        pair.connect()
        for _ in range(10):
            pair.run(moments.uniform(0.2, 3.0))
            pair.ask(Stop() if moments.random() < 0.4 else Drive(Motion.BACK, 0.3))
        pair.run(6.0)
        intervals_s = pair.control.driver.model.learned.echo.intervals
        assert all(abs(each - 2.2) < 0.1 for each in intervals_s), f"seed {seed}: {intervals_s}"


def test_silent_raspberry_pi_is_taken_as_such_until_reading() -> None:
    pair = Pair("course", told="raspberry_pi", start_s=2.0)
    pair.connect()
    control = pair.control
    pair.until(lambda: control.driver.model.profile.name == "raspberry_pi+no_readings", 15.0)
    pair.until(lambda: control.driver.model.at_rest, 3.0)
    pair.ask(Drive(Motion.FORWARD, 1.0), identity="drive")
    pair.run(2.0)
    pair.ask(Stop(), identity="stop")
    pair.run(3.0)
    ends = [pair.last_of(each) for each in ("drive", "stop")]
    assert [(end.phase, end.basis) for end in ends if end is not None] == [("sent", "sent")] * 2
    assert "platform_contradicted" in {record.code for record in pair.logs}
    assert not any(b"MODE" in data for _, data in pair.sent)
    control.driver.shut_down(pair.now)
    pair.until(lambda: control.driver.finished, 2.0)
    assert not control.driver.stops.not_stopped


def test_raspberry_pi_car_that_reports_after_all_has_readings() -> None:
    pair = Pair("raspberry_pi", start_s=2.0)
    feed = pair.decoder.feed
    pair.decoder.feed = lambda *_: []  # type: ignore[method-assign]  # a wire that carries nothing
    pair.control.link_up(pair.now)
    pair.until(lambda: pair.control.driver.model.profile.name == "raspberry_pi+no_readings", 15.0)
    pair.decoder.feed = feed  # type: ignore[method-assign]
    pair.run(10.0)
    assert pair.control.driver.model.profile.name == "raspberry_pi"
    assert not pair.control.driver.model.platform.doubted
    pair.lose()
    pair.decoder.feed = lambda *_: []  # type: ignore[method-assign]
    pair.control.link_up(pair.now)
    pair.run(20.0)
    assert pair.control.driver.model.profile.name == "raspberry_pi", "it reported before: its silence is odd"
    assert not pair.control.driver.model.is_heard


@pytest.mark.parametrize(
    ("platform", "told", "counts_as"),
    [
        ("arduino", "arduino+no_readings", "arduino"),
        ("raspberry_pi", "raspberry_pi+no_readings", "raspberry_pi"),
        ("arduino", "auto+no_readings", "arduino"),
    ],
)
def test_readings_end_the_option_that_there_are_none(platform: str, told: str, counts_as: str) -> None:
    pair = Pair(platform, told=counts_as, start_s=2.0)
    name, auto = parse_option(told)
    pair.control = control(parse_platform(name), auto=auto)
    pair.connect()
    pair.run(30.0)
    model = pair.control.driver.model
    assert (model.profile.name, model.platform.doubted) == (counts_as, False)
    assert bool(model.platform.contradictions) is not auto
    assert model.shows_stops[0] is (Shows.NO if platform == "raspberry_pi" else Shows.YES)
    if platform == "raspberry_pi":
        assert not any(b"MODE" in data for _, data in pair.sent), "it would end some programs"


@pytest.mark.parametrize("told", ["auto", "arduino"])
@pytest.mark.parametrize("other", ["raspberry_pi", "stm32"])
def test_claim_of_previous_program_ends_with_first_readings(told: str, other: str) -> None:
    name, auto = parse_option(told)
    pair = Pair("arduino", told="arduino", start_s=2.0)
    pair.control = control(parse_platform(name), auto=auto)
    pair.connect()
    model = pair.control.driver.model
    pair.until(lambda: model.at_rest and model.trust.shown and model.learned.echo.is_firm, 60.0)
    pair.car = Pair(other, start_s=2.0).car
    pair.car.advance(pair.now)
    pair.until(lambda: model.trust.basis is None, 6 * 1.254)
    assert model.learned.shows is Shows.UNKNOWN
    pair.until(lambda: model.trust.basis is Basis.SENT, 20.0)
    assert model.shows_stops[0] is not Shows.YES
    answer = pair.ask(Drive(Motion.FORWARD, 1.0), identity="drive")
    assert answer.status != "rejected", answer


@pytest.mark.parametrize(
    ("first", "other"), [("raspberry_pi", "arduino"), ("arduino", "raspberry_pi"), ("stm32", "arduino")]
)
def test_platform_is_detected_again_after_program_swap(first: str, other: str) -> None:
    pair = Pair(first, start_s=2.0)
    name, auto = parse_option("auto")
    pair.control = control(parse_platform(name), auto=auto)
    pair.connect()
    model = pair.control.driver.model
    pair.until(lambda: model.profile.name == first and model.at_rest and model.learned.echo.is_firm, 60.0)
    pair.car = Pair(other, start_s=2.0).car
    pair.car.advance(pair.now)
    pair.until(lambda: model.profile.name == other, OTHER_PROGRAM_FRAMES * 1.3 + 5.0)
    if other == "arduino":
        assert pair.ask(SetMode(Mode.TRACKING), identity="mode").status != Phase.REJECTED
        pair.until(lambda: pair.car.truth.mode is Mode.TRACKING, 20.0)


def swapped(told: str, mode: Mode) -> Pair:
    """Let the car's program change to a Raspberry Pi's on the link while a silent mode is open."""
    name, auto = parse_option(told)
    pair = Pair("arduino", told="arduino", start_s=2.0)
    pair.control = control(parse_platform(name), auto=auto)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.profile.kind == "arduino" and pair.control.is_free(pair.now), 30.0)
    pair.ask(SetMode(mode), identity="mode")
    pair.until(lambda: pair.control.driver.model.mode.asked is mode, 15.0)
    pair.run(6.0)
    other = Pair("raspberry_pi", start_s=2.0)
    pair.car = other.car
    pair.car.advance(pair.now)
    return pair


@pytest.mark.parametrize("told", ["auto", "arduino"])
def test_program_that_changes_in_a_silent_mode_is_drivable(told: str) -> None:
    pair = swapped(told, Mode.COLOR_LED)
    pair.until(lambda: pair.control.driver.model.mode.is_over, 15.0)
    answer = pair.ask(Drive(Motion.FORWARD, 1.0), identity="drive")
    assert answer.status != "rejected", answer
    pair.run(15.0)
    last = pair.last_of("drive")
    assert last is not None
    assert last.phase in ("sent", "complete"), last
    assert pair.control.driver.model.learned.opened_as == "", "readings have shown mode 0"


def test_new_frame_head_is_used_at_once() -> None:
    pair = Pair(told="arduino+head=TANK", start_s=2.0)
    pair.car.feed(b"$4WD,MODE21#", pair.now)
    pair.run(4.0, linked=False)
    pair.decoder.use_head("TANK")
    pair.control.link_up(pair.now)
    began = pair.now
    pair.decoder = FrameSplitter(head="TANK")
    pair.until(lambda: pair.control.driver.model.profile.dialect.head == "4WD", 3.0)
    pair.until(lambda: pair.car.truth.mode is Mode.MANUAL, began + 6.0 - pair.now)
    assert not pair.car.truth.driving


@pytest.mark.parametrize("told", ["arduino", "auto"])
def test_corrected_head_neither_cuts_nor_delays_drive(told: str) -> None:
    name, auto = parse_option(told)
    for tenth in range(0, 40, 3):
        pair = Pair(start_s=2.0, traits=CarTraits(head="3WD"))
        pair.control = control(parse_platform(name), auto=auto)
        pair.connect()
        pair.run(tenth / 10)
        asked_at = pair.now
        answer = pair.ask(Drive(Motion.FORWARD, 2.0), identity="drive")
        assert answer.status != Phase.REJECTED, answer
        bound_s = max(pair.control.wait_s(Drive(Motion.FORWARD, 2.0), asked_at), 0.0) + 0.3
        pair.until(lambda pair=pair: pair.sent[-1][1].startswith(b"$1"), bound_s)
        began_at = pair.sent[-1][0]
        pair.run(3.0)
        last = pair.last_of("drive")
        assert last is not None
        assert (last.phase, last.basis) == (Phase.SENT, "sent"), last
        stops = [at for at, data in pair.sent if at > began_at and data.startswith(b"$0")]
        assert abs(min(stops) - began_at - 2.0) <= 0.1, (told, tenth)
