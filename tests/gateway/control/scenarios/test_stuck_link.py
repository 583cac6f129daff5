"""Tests of an open link that delivers nothing: claims about the car meanwhile, and stops after the link recovers."""

import random
from collections.abc import Callable
from itertools import pairwise

import pytest

from gateway.control.commands import Drive, Led, SetMode, Stop
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.words import Basis, CarTrust, Mode, Motion, Phase, Reason, Shows
from tests.support.stops import ENDS_S
from tests.support.virtual import Pair

FORWARD = Drive(Motion.FORWARD, 3.0)


class Wire:
    """The wire between control and the car. While it is stuck, it accepts all written frames and holds them."""

    def __init__(self, pair: Pair) -> None:
        self._pair = pair
        self._feed = pair.car.feed
        self._receive = pair._receive
        self._kept = b""
        self.stuck = False
        pair.car.feed = self.feed  # type: ignore[method-assign]
        pair._receive = self.receive  # type: ignore[method-assign]

    def feed(self, data: bytes, now: float) -> None:
        if self.stuck:
            self._kept += data
        else:
            self._feed(data, now)

    def receive(self, *, linked: bool) -> None:
        self._receive(linked=linked and not self.stuck)
        if self.stuck:
            self._pair.decoder.flush(self._pair.now)
            self._pair.tick()

    def free(self) -> None:
        self.stuck = False
        self._feed(self._kept, self._pair.now)


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
def test_unheard_car_may_be_moving_and_is_stopped_on_return(platform: str) -> None:
    pair = Pair(platform, start_s=2.0).ready()
    pair.logs.clear()
    wire = Wire(pair)
    pair.ask(FORWARD)
    pair.run(0.2)
    wire.stuck = True
    took = pair.until(lambda: pair.control.driver.model.motors == "unknown", 6.0)
    assert took > 1.9, "the silence that a report without echo explains is none"
    pair.run(5.0)
    assert pair.car.truth.motor_left, "its stop is in the wire"
    assert pair.control.driver.model.motors == "unknown"
    pair.ask(Drive(Motion.BACK, 0.5))  # the wire also holds this drive and its stops, and delivers them together
    pair.run(3.0)
    wire.free()
    pair.until(lambda: pair.control.driver.model.motors == "off", 12.0)
    assert not pair.car.truth.motor_left
    codes = [log.code for log in pair.logs]
    assert codes.index("recovered") > codes.index("answers_again") > codes.index("unheard"), "no claim before it"


def test_driven_car_is_not_assumed_heard() -> None:
    """Frames without a block explain no silence, however many."""
    pair = Pair("arduino", start_s=2.0).ready()
    wire = Wire(pair)
    wire.stuck = True
    for number in range(20):
        pair.ask(Drive((Motion.FORWARD, Motion.BACK)[number % 2], 0.5))
        pair.run(0.25)
    assert pair.control.driver.model.motors == "unknown"
    assert "unheard" in [log.code for log in pair.logs]
    answer = pair.ask(Drive(Motion.FORWARD, 25.0))
    assert answer.status is Phase.QUEUED, "what is not shown forbids nothing"
    assert "nothing shows" in answer.words


def test_stream_from_before_silence_or_lost_link_drives_no_car() -> None:
    for how in ("silence", "link"):
        pair = Pair("arduino", start_s=2.0).ready()
        wire = Wire(pair)
        wire.stuck = how == "silence"
        if how == "link":
            pair.lose()
        for _ in range(80):
            pair.ask(Drive(Motion.FORWARD, 0.5), streamed=True)
            pair.run(0.1, linked=how == "silence")
        if how == "link":
            pair.connect()
        else:
            wire.free()
        for _ in range(150):
            pair.ask(Drive(Motion.FORWARD, 0.5), streamed=True)
            pair.run(0.1)
        assert not pair.car.truth.driving, how
        pair.run(0.6)
        pair.ask(Drive(Motion.FORWARD, 0.5), streamed=True)
        pair.run(0.1)
        assert pair.car.truth.driving, "another press does"


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
def test_stop_that_a_stuck_link_keeps_is_not_complete(platform: str) -> None:
    """The answer warns at once, and the stop fails while the car is silent. With a free wire the next stop ends."""
    ends = (Phase.SENT, Basis.SENT) if platform == "raspberry_pi" else (Phase.COMPLETE, Basis.SHOWN)
    pair = Pair(platform, start_s=2.0).ready()
    wire = Wire(pair)
    pair.ask(FORWARD)
    pair.run(0.2)
    wire.stuck = True
    pair.until(lambda: pair.control.driver.model.motors == "unknown", 6.0)
    answer = pair.ask(Stop(), identity="stop")
    assert answer.words.startswith("red may not ")
    pair.until(lambda: pair.last_of("stop") is not None, ENDS_S)
    failed = pair.last_of("stop")
    assert failed is not None
    assert (failed.phase, failed.reason) == (Phase.FAILED, Reason.NOT_SHOWN)
    assert pair.car.truth.motor_left, "it is in the wire"
    pair.ask(Stop(), identity="again")
    pair.run(1.0)
    wire.free()
    pair.until(lambda: pair.last_of("again") is not None, ENDS_S)
    last = pair.last_of("again")
    assert last is not None
    assert (last.phase, last.basis) == ends
    assert not pair.car.truth.motor_left
    assert pair.control.driver.model.motors == "off"


def test_stop_in_obstacle_avoidance_is_no_silence() -> None:
    pair = Pair("arduino", start_s=2.0).ready()
    pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE))
    pair.run(8.0)
    for _ in range(10):
        pair.ask(Stop())
        pair.until(lambda: pair.control.driver.model.motors == "off", 8.0)
        pair.run(6.0)
        pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE))
        pair.run(8.7)
    assert not [log for log in pair.logs if log.code in ("unheard", "mode_contradicted")]


# ---------------------------------------------------------------------- a link that loses written frames


def slow(pair: Pair, delay_s: float) -> None:
    """Delay all bytes in both directions by `delay_s` from now on."""
    feed, advance = pair.car.feed, pair.car.advance
    down: list[tuple[float, bytes]] = []
    up: list[tuple[float, bytes]] = []

    def delayed(now: float) -> list[tuple[float, bytes]]:
        while down and down[0][0] <= now:
            at, data = down.pop(0)
            up.extend((each + delay_s, sent) for each, sent in advance(at))
            feed(data, at)
        up.extend((each + delay_s, sent) for each, sent in advance(now))
        due = [each for each in up if each[0] <= now]
        del up[: len(due)]
        return due

    def next_event() -> float:
        return min(own_event(), *(each[0] for each in (*down[:1], *up[:1])), float("inf"))

    own_event = pair.car.next_event
    pair.car.feed = lambda data, now: down.append((now + delay_s, data))  # type: ignore[method-assign]
    pair.car.advance = delayed  # type: ignore[method-assign]
    pair.car.next_event = next_event  # type: ignore[method-assign]


def deaf(pair: Pair) -> list[bytes]:
    """Lose all written frames from now on. Return the list that collects them."""
    lost: list[bytes] = []
    pair.car.feed = lambda data, now: lost.append(data)  # type: ignore[method-assign]
    return lost


def test_lost_stop_is_never_complete_and_goes_on() -> None:
    """A deaf car keeps reporting, or no pause shows the stop (docs/reference/protocol.md#evidence-of-a-stop)."""
    tries = 40
    for seed in range(tries):
        pair = Pair(seed=seed, start_s=2.0).ready()
        pair.until(lambda pair=pair: pair.control.driver.model.trust.shown, 12.0)
        pair.run(seed / tries)
        pair.ask(Drive(Motion.FORWARD, 9.0))
        pair.run(1.5)
        hears = pair.car.feed
        deaf(pair)
        pair.ask(Stop(), identity="stop")
        pair.run(40.0)
        assert pair.car.truth.motor_left
        last = pair.last_of("stop")
        assert last is not None
        assert (last.phase, last.reason) == (Phase.FAILED, Reason.NOT_SHOWN)
        assert last.words.startswith("NOT CONFIRMED: red has not reacted to the stop yet. Look at the car.")
        lost = next(log.words for log in pair.logs if log.code == "not_obeyed")
        assert lost.startswith("red did not ")
        codes = [log.code for log in pair.logs]
        assert codes.count("not_obeyed") == codes.count("not_shown") == 1, "said once"
        assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("unknown", None)
        assert pair.control.driver.model.trust.state is CarTrust.UNPROVEN
        assert pair.control.driver.lost_frames
        pair.car.feed = hears  # type: ignore[method-assign]
        pair.until(lambda pair=pair: pair.control.driver.model.motors == "off", 20.0)
        assert pair.control.driver.model.basis == Basis.SHOWN
        assert not pair.car.truth.motor_left, "stopped when it hears again, without being asked"
        assert pair.logs[-1].code in ("hears", "recovered")


def doubtful() -> Pair:
    """Return a car that has shown a stop, is deaf now, and has not shown the next one."""
    pair = Pair("arduino", start_s=2.0).ready()
    pair.until(lambda: pair.control.driver.model.trust.shown, 12.0)
    pair.hears = pair.car.feed  # type: ignore[attr-defined]  # for the tests that give it back
    deaf(pair)
    pair.ask(Stop())
    pair.until(lambda: pair.control.driver.model.trust.state is CarTrust.UNPROVEN, 30.0)
    return pair


def test_car_deaf_from_start_cannot_show_stop() -> None:
    """Nothing tells it from a car whose program reports by a timer. It can be used, and no claim is `shown`."""
    pair = Pair("arduino", start_s=2.0)
    deaf(pair)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.learned.shows is Shows.NO, 30.0)
    pair.run(1.0)
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", Basis.SENT)
    assert [log.code for log in pair.logs].count("cannot_show") == 1
    assert pair.ask(Drive(Motion.FORWARD, 1.0)).status is Phase.QUEUED


@pytest.mark.parametrize("seed", range(8))
def test_timer_car_cannot_show_stop(seed: int) -> None:
    pair = Pair("arduino", seed=seed, traits=CarTraits(interval_s=1.0, timer=True, close_s=0.0), start_s=2.0)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.learned.shows is Shows.NO, 30.0)


def test_deaf_car_is_stopped_for_ever_with_growing_pauses() -> None:
    pair = doubtful()
    pair.run(300.0)
    assert pair.control.driver.model.trust.state is CarTrust.UNPROVEN
    times = [at for at, _ in pair.sent]
    assert max(later - earlier for earlier, later in pairwise(times)) < 10.0
    assert pair.now - times[-1] < 10.0
    codes = [log.code for log in pair.logs]
    assert codes.count("not_obeyed") == codes.count("not_shown") == 1, "said once"
    assert len(pair.logs) < 6


def test_deaf_car_driven_by_others_is_stopped_again_and_never_claimed() -> None:
    pair = doubtful()
    pair.shown_at.clear()
    for number in range(3):
        assert pair.ask(Drive(Motion.FORWARD, 3.0), identity=f"drive{number}").status is Phase.QUEUED
        pair.run(9.0)
        assert Phase.SENT in pair.phases(f"drive{number}")
        pair.ask(Stop(), identity=f"stop{number}")
        pair.until(lambda number=number: pair.last_of(f"stop{number}") is not None, ENDS_S)
        last = pair.last_of(f"stop{number}")
        assert last is not None
        assert last.phase is Phase.FAILED
        assert pair.control.driver.model.basis != Basis.SHOWN
    assert len(pair.shown_at) <= 1, "the one from before it was deaf"


def test_doubt_without_reason_ends_before_anybody_asks() -> None:
    pair = doubtful()
    assert pair.control.driver.model.motors == "unknown"
    pair.car.feed = pair.hears  # type: ignore[method-assign,attr-defined]
    pair.until(lambda: pair.control.driver.model.motors == "off", 15.0)
    assert pair.control.driver.model.basis == Basis.SHOWN
    assert {"not_obeyed", "hears"} <= {log.code for log in pair.logs}


@pytest.mark.parametrize("delay_s", [0.02, 0.1, 0.25, 0.4])
def test_slow_link_is_no_deaf_one(delay_s: float) -> None:
    """Reports that a car sent before it received `MODE00` do not show whether `MODE00` arrived."""
    pair = Pair("arduino", start_s=2.0)
    slow(pair, delay_s)
    pair.ready()
    moments = random.Random(7)
    for number in range(60):
        pair.ask(Drive(Motion.FORWARD, 2.0))
        pair.run(2.5 * moments.random())
        pair.ask(Stop(), identity=f"stop{number}")
        pair.until(lambda number=number: pair.last_of(f"stop{number}") is not None, ENDS_S)
        assert pair.phases(f"stop{number}")[-1] is Phase.COMPLETE
        assert pair.control.driver.model.basis == Basis.SHOWN
        assert not pair.car.truth.motor_left
        pair.run(2.0 * moments.random())
    assert pair.control.driver.lost_frames == 0
    assert pair.control.driver.model.motors == "off"


@pytest.mark.parametrize("world", [World.room, World.open_field], ids=["echo", "no-echo"])
@pytest.mark.parametrize("platform", ["arduino", "stm32", "raspberry_pi"])
def test_no_stop_that_was_obeyed_is_thought_to_be_lost(platform: str, world: Callable[[], World]) -> None:
    pair = Pair(platform, world=world(), start_s=2.0).ready()
    moments = random.Random(7)
    for _ in range(60):
        pair.ask(moments.choice([Drive(Motion.FORWARD, 2.0), Led(1, 2, 3), SetMode(Mode.MANUAL)]))  # type: ignore[arg-type]
        pair.run(2.5 * moments.random())
        pair.ask(Stop())
        pair.run(4.0 * moments.random())
    assert pair.control.driver.lost_frames == 0
