"""Tests each row of the hazards tables of docs/reference/protocol.md twice: with careless frames, and with control.

The careless half writes frames straight to the simulated car. tests/gateway/sim/hazards.py asserts the result. Our half
requests the same from the gateway's control, in the same situation. The simulated car's motors judge both.
"""

import random
from collections.abc import Callable
from itertools import pairwise

import pytest

from gateway.control.commands import AimServo, Answer, Drive, Fan, Led, MoveArm, PartAction, SetLight, SetMode, Stop
from gateway.drivers.yahboom.protocol.frames import General, parse_sent
from gateway.drivers.yahboom.stops import cases
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.world import World
from schemas.words import Basis, Light, Mode, Motion, Phase, Reason
from tests.gateway.sim.hazards import HAZARDS, Hazard
from tests.gateway.sim.strangers import virtual
from tests.support.virtual import Pair

RECOVERED_S = 7.3
"""Maximum time of recovery outside avoidance, in theory (docs/reference/protocol.md#stops)."""
WORST_SOFT_S = 1.1 + 1.0 + 0.3
"""Maximum time of the end of a drive: the second stop, behind a distance measurement, and the wire."""
SETTLED_S = 12.0
"""Time in which every stop ends, and in which a car that drives on shows it."""

Ours = Callable[[Pair], None]
OURS: dict[str, Ours] = {}


def ours(*rows: str) -> Callable[[Ours], Ours]:
    """Register the gateway's half of each row whose words begin with one of `rows`."""

    def keep(play: Ours) -> Ours:
        OURS.update(dict.fromkeys(rows, play))
        return play

    return keep


def of(hazard: Hazard) -> Ours:
    found = [play for row, play in OURS.items() if hazard.row.startswith(row)]
    assert len(found) == 1, f"{hazard.row!r} has {len(found)} counterparts"
    return found[0]


@pytest.mark.parametrize("hazard", HAZARDS, ids=str)
async def test_careless_and_ours(hazard: Hazard) -> None:
    await hazard.play(virtual(hazard.platform, world=hazard.world(), tcp=hazard.tcp))
    transport = Transport.TCP if hazard.tcp else Transport.SERIAL
    pair = Pair(hazard.platform, world=hazard.world(), transport=transport).ready()
    of(hazard)(pair)
    assert all(parse_sent(data) is not None for _, data in pair.sent), "one whole frame in each write"


def test_every_counterpart_has_its_row() -> None:
    rows = [hazard.row for hazard in HAZARDS]
    assert [row for row in OURS if not any(name.startswith(row) for name in rows)] == []


# ---------------------------------------------------------------------- the judge


def driving(pair: Pair, motion: Motion = Motion.FORWARD) -> None:
    pair.ask(Drive(motion, 10.0))
    pair.until(lambda: pair.car.truth.driving, 3.0)


def blocked(pair: Pair, by: PartAction | Fan) -> None:
    """Block the car with a frame, and wait until the block begins."""
    pair.ask(by)
    pair.until(lambda: pair.car.truth.blocked, 3.0)


def stops(pair: Pair, *, sent: StopCase | None = None) -> Answer:
    """Request a stop. Require that the motors are off for good within the announced time.

    `sent` is the case of the stop if the car cannot show it.
    """
    asked_at = pair.now
    answer = pair.ask(Stop(), verb="stop", identity="the-stop")
    pair.run(SETTLED_S)
    assert pair.off_for_good_at() - asked_at <= answer.worst_case_s
    pi = isinstance(pair.car, RaspberryPiCar)
    case = cases.RASPBERRY_PI if pi else sent
    last = pair.last_of("the-stop")
    assert last is not None
    if case is None:
        assert (last.phase, last.basis) == (Phase.COMPLETE, Basis.SHOWN)
    else:
        words = case.why("red")
        assert (last.phase, last.basis, last.words) == (Phase.SENT, Basis.SENT, words)
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", last.basis)
    pair.records.clear()
    return answer


def recovers(pair: Pair) -> None:
    """Open the link again. Require that recovery brings the car to rest in mode 0, and that the gateway knows it."""
    since = pair.now
    assert pair.control.driver.model.motors == "unknown"
    pair.connect()
    pair.until(lambda: pair.control.driver.model.known, 30.0)
    pair.run(SETTLED_S)
    assert pair.off_for_good_at() - since <= RECOVERED_S
    assert pair.car.truth.mode is Mode.MANUAL
    assert pair.control.driver.model.motors == "off"


def refused(pair: Pair, what: PartAction | SetMode) -> None:
    sent = len(pair.sent)
    assert pair.ask(what).reason is Reason.UNSUPPORTED
    pair.run(2.0)
    repeated = General(Motion.FORWARD if pair.car.truth.driving else Motion.STOP)
    assert all(parse_sent(data) == repeated for _, data in pair.sent[sent:]), "only the repetition"


PTZ = AimServo(90)


# ---------------------------------------------------------------------- the Arduino program


@ours("one frame while it is blocked")
def one_frame(pair: Pair) -> None:
    """Request a run during a block. The car obeys after the block, and the run ends when its time is over."""
    blocked(pair, PTZ)
    pair.ask(Drive(Motion.FORWARD, 1.5))
    pair.until(lambda: pair.car.truth.driving, 1.5)
    pair.run(SETTLED_S)
    assert pair.off_for_good_at() < pair.now - 5.0


@ours("two frames while it is blocked, the second a stop")
def two_frames(pair: Pair) -> None:
    blocked(pair, PTZ)
    pair.ask(Drive(Motion.FORWARD, 5.0))
    stops(pair)


@ours("two frames in a ranging without an echo, the second cut by its end")
def cut_by_the_end(pair: Pair) -> None:
    """Request two servo angles, at moments at which the second frame could arrive as a ranging ends."""
    for step in range(24):
        pair.until(lambda: not pair.car.truth.blocked, 3.0)
        pair.until(lambda: pair.car.truth.blocked, 3.0)
        pair.run(0.32 + 0.002 * step)
        pair.ask(AimServo(22))
        pair.ask(AimServo(161))
        pair.run(4.0)
        assert pair.car.truth.servo == 180 - 161, "the second one is obeyed, too"
    assert len(pair.car.motor_log) == 1, "no change since the beginning"


@ours("a run, 60 ms, a stop, while the ranging gets no echo")
def no_echo(pair: Pair) -> None:
    pair.until(lambda: not pair.car.truth.blocked, 3.0)
    pair.until(lambda: pair.car.truth.blocked, 3.0)
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.run(0.06)
    stops(pair, sent=cases.NO_ECHO)


@ours("stop, then MODE00, both while blocked")
def stop_then_mode(pair: Pair) -> None:
    driving(pair)
    blocked(pair, PTZ)
    pair.ask(Drive(Motion.STOP))
    pair.ask(SetMode(Mode.MANUAL))
    pair.run(SETTLED_S)
    assert pair.off_for_good_at() < pair.now - 5.0
    assert pair.car.truth.mode is Mode.MANUAL


@ours("MODE00, then stop, both while blocked")
def mode_then_stop(pair: Pair) -> None:
    driving(pair)
    blocked(pair, PTZ)
    pair.ask(SetMode(Mode.MANUAL))
    stops(pair)


@ours("MODE00 alone, in any mode (", "a general stop in a mode other than 0")
def in_any_mode(pair: Pair) -> None:
    """End the motion in every mode. The gateway writes the frames that stop the car in that mode."""
    for mode in (mode for mode in Mode if mode is not Mode.MANUAL):
        driving(pair)
        pair.ask(SetMode(mode))
        pair.until(lambda mode=mode: pair.car.truth.mode is mode, 12.0)
        pair.run(5.0)
        asked_at = pair.now
        answer = pair.ask(Drive(Motion.STOP))
        pair.run(SETTLED_S)
        assert pair.off_for_good_at() - asked_at <= answer.worst_case_s
        assert pair.car.truth.mode is Mode.MANUAL


@ours("a mode opened while driving (")
def opened_while_driving(pair: Pair) -> None:
    """Require that the motors are off before the gateway writes the frame of the mode."""
    for mode in (Mode.REMOTE_CONTROL, Mode.COLOR_LED, Mode.TRACKING):
        driving(pair, Motion.BACK)
        pair.ask(SetMode(mode), identity=mode)
        pair.until(lambda mode=mode: Phase.SENT in pair.phases(mode), 6.0)
        assert pair.off_for_good_at() < pair.now
        pair.until(lambda mode=mode: pair.car.truth.mode is mode, 3.0)
        assert not pair.car.truth.driving
        stops(pair)


@ours("a named frame it does not know: wedged")
def wedged(pair: Pair) -> None:
    driving(pair)
    refused(pair, MoveArm((90,) * 6))
    stops(pair)


def cut(pair: Pair, what: PartAction | Drive, count: int) -> None:
    """Cut the next write after `count` bytes, and the link with it."""
    pair.cut = count
    pair.ask(what)
    pair.run(2.0)
    assert pair.cut is None


@ours("half of a named frame: wedged", "half of a named frame, then a MODE frame: it can OPEN mode 4")
def half_named(pair: Pair) -> None:
    for what, length in ((PTZ, 12), (Led(255, 0, 16), 24)):
        for count in range(1, length):
            driving(pair)
            cut(pair, what, count)
            assert pair.car.truth.driving
            recovers(pair)


@ours(
    "half a general frame, then a stop",
    "half a general frame, then MODE00",
    "a lone # ends a half frame, whose motion is then obeyed",
)
def half_general(pair: Pair) -> None:
    for count in range(1, 19):
        driving(pair)
        cut(pair, Drive(Motion.BACK, 5.0), count)
        assert pair.car.truth.driving
        recovers(pair)


@ours("a MODE frame that lost one digit or both (")
def digitless(pair: Pair) -> None:
    """Lose the digits of the first `MODE00` of a stop. Require that the stop ends only when the motors are off."""
    for lost in (b"0", b"00"):
        driving(pair)
        lose_once(pair, lost)
        pair.ask(Stop(), verb="stop", identity="the-stop")
        pair.until(lambda: pair.last_of("the-stop") is not None, 30.0)
        pair.pass_frames()
        last = pair.last_of("the-stop")
        assert last is not None
        assert (last.phase, last.basis) == (Phase.COMPLETE, Basis.SHOWN)
        assert pair.off_for_good_at() < pair.now
        pair.records.clear()


def lose_once(pair: Pair, lost: bytes) -> None:
    """Lose these bytes of the next `MODE00`."""
    feed, left = pair.car.feed, [lost]

    def deliver(data: bytes, now: float) -> None:
        is_hit = bool(left) and data == b"$4WD,MODE00#"
        feed(data.replace(left.pop(), b"", 1) if is_hit else data, now)

    pair.car.feed = deliver  # type: ignore[method-assign]


@ours("a lone # with nothing pending acts as a stop in mode 0")
def lone_hash(pair: Pair) -> None:
    """Require that only recovery writes a lone `#`, since recovery stops the car anyway."""
    driving(pair)
    assert not any(data == b"#" for _, data in pair.sent[4:])
    pair.lose()
    assert pair.car.truth.driving
    recovers(pair)


@ours("half a frame, #, 50 ms, MODE00, all while blocked")
def half_while_blocked(pair: Pair) -> None:
    """Cut the second frame of a recovery, and begin the next recovery, all within one block."""
    for count in range(1, 12):
        driving(pair)
        blocked(pair, PTZ)
        pair.lose()
        pair.connect()
        pair.cut = count
        pair.run(0.02)
        pair.until(lambda: pair.cut is None, 0.1)
        assert pair.car.truth.blocked
        recovers(pair)


@ours("the fan on: obeys motion, but sends no readings until it is off again")
def fan(pair: Pair) -> None:
    """Stop a car whose fan runs. The stop ends without a reading, only as `sent`, and does not toggle the fan."""
    pair.ask(Fan())
    pair.until(lambda: pair.car.truth.fan, 3.0)
    driving(pair)
    stops(pair, sent=cases.FAN)
    assert pair.car.truth.fan
    assert sum(frame.fan for frame in general(pair)) == 1


def general(pair: Pair) -> list[General]:
    frames = (parse_sent(data) for _, data in pair.sent)
    return [frame for frame in frames if isinstance(frame, General)]


# ---------------------------------------------------------------------- the Raspberry Pi programs


@ours("a MODE frame: nothing")
def pi_mode(pair: Pair) -> None:
    driving(pair)
    refused(pair, SetMode(Mode.TRACKING))
    stops(pair)
    assert not any(b"MODE" in data for _, data in pair.sent)


@ours(
    "over TCP, a frame cut over two receives is ignored whole",
    "over TCP, a write not beginning with $ is ignored whole",
    "over TCP, two frames in one receive: only the first",
)
def pi_writes(pair: Pair) -> None:
    """Require one whole frame in each write, 60 ms apart, so that no receive joins or cuts frames."""
    moments = random.Random(7)
    for _ in range(30):
        pair.ask(Drive(moments.choice([Motion.FORWARD, Motion.BACK, Motion.LEFT]), 5.0))
        pair.run(0.1 * moments.random())
    stops(pair)
    assert all(data.startswith(b"$") and data.endswith(b"#") for _, data in pair.sent)
    times = [at for at, _ in pair.sent]
    assert min(b - a for a, b in pairwise(times)) >= 0.06 - 1e-9


@ours(
    "over TCP, two frames while the fan blocks it: only the first",
    "over Bluetooth, several frames while it is blocked: only the LAST",
)
def pi_fan(pair: Pair) -> None:
    blocked(pair, Fan())
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.run(0.06)
    stops(pair)
    blocked(pair, Fan())
    for motion in (Motion.FORWARD, Motion.STOP, Motion.BACK):
        pair.ask(Drive(motion, 5.0))
    pair.until(lambda: pair.car.truth.driving, 3.0)
    assert pair.car.truth.motor_left < 0, "the newest motion wins"
    stops(pair)


@ours("a short frame kills the program")
def pi_short(pair: Pair) -> None:
    """Require that the gateway writes each general frame whole, with its nine fields."""
    pi_writes(pair)
    assert all(len(data) == 19 for _, data in pair.sent)
    assert pair.car.alive


@ours("over Bluetooth a half frame ended by a lone # kills the program")
def pi_lone_hash(pair: Pair) -> None:
    for count in range(1, 19):
        driving(pair)
        cut(pair, Drive(Motion.BACK, 5.0), count)
        recovers(pair)
        assert pair.car.alive
    assert not any(data == b"#" for _, data in pair.sent)


@ours("the TCP client goes away")
def pi_hang_up(pair: Pair) -> None:
    """Require that the gateway closes only after a stop. It cannot prevent a lost link, so it reports the danger."""
    driving(pair)
    pair.control.driver.shut_down(pair.now)
    pair.until(lambda: pair.control.driver.finished, 3.0)
    pair.lose("closed")
    pair.run(SETTLED_S, linked=False)
    assert not pair.car.alive
    assert not pair.car.truth.driving

    cut_off = Pair("raspberry_pi", transport=Transport.TCP).ready()
    driving(cut_off)
    cut_off.lose("connection refused")
    cut_off.run(2.0, linked=False)
    assert not cut_off.car.alive
    assert cut_off.car.truth.driving
    assert cut_off.control.driver.model.motors == "unknown"
    answer = cut_off.ask(Stop(), verb="stop")
    assert answer.reason is Reason.LINK_DOWN
    assert answer.words.startswith("NOT STOPPED: red is unreachable. If it was driving, it still is")


@ours("light 1 cycles; lights 5..8 are not known")
def pi_light(pair: Pair) -> None:
    for light in (Light.WHITE, Light.CYAN, Light.MAGENTA, Light.YELLOW, Light.OFF):
        refused(pair, SetLight(light))
    before = pair.car.truth.led
    pair.ask(SetLight(Light.GREEN))
    pair.run(1.0)
    assert (before, pair.car.truth.led) == ("off", "#00ff00")


# ---------------------------------------------------------------------- no dead-man


@ours("no dead-man")
def dead_man(pair: Pair) -> None:
    """Require that a motion that nobody renews ends by itself, half a second after its request."""
    pair.ask(Drive(Motion.FORWARD))
    asked_at = pair.now
    pair.run(SETTLED_S)
    assert asked_at < pair.off_for_good_at() <= asked_at + 0.5 + 0.1


@pytest.mark.parametrize("drive_s", [0.3, 1.6, 2.5])
@pytest.mark.parametrize("period_s", [0.3, 0.5, 0.9])
@pytest.mark.parametrize("phase", range(10))
def test_colors_do_not_put_off_the_stop_of_a_drive(phase: int, period_s: float, drive_s: float) -> None:
    """Without an echo, the car lost the stop behind the repeated motion, or before a color, and drove on for 9.8 s."""
    pair = Pair("arduino", seed=phase, world=World.open_field()).ready()
    pair.run(3.0 + 0.17 * phase)
    pair.ask(Drive(Motion.FORWARD, drive_s))
    pair.run(drive_s + 0.13)
    ended_at, red = pair.now, 110
    while pair.car.truth.driving:
        assert pair.now < ended_at + WORST_SOFT_S
        red += 1
        pair.ask(Led(red, 0, 0))
        pair.run(period_s)
    pair.run(SETTLED_S)
    assert pair.off_for_good_at() < ended_at + WORST_SOFT_S
