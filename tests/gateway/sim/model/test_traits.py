"""Cars of the Arduino program with other traits, on virtual time. The numbers were measured on public programs."""

import re
from itertools import pairwise

import pytest

from gateway.control.driver import Rejected
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.words import Cause, Mode
from tests.gateway.sim.strangers import FAN, MODE00, PTZ90, RUN, STOP, WHISTLE, VirtualStranger, opening, virtual

COLOR = b"$4WD,CLR255,CLG0,CLB0#"
MEASURED_S = 1.254
"""Interval of the vendor's Arduino program as recent IDEs compile it, with an echo."""
RESOLUTION_S = 0.003
SLACK_S = 0.025
"""More than the ways of an echo differ in the room, and than 0.65 s of the table differs from 0.636 s of a servo."""


async def report_times(car: VirtualStranger, seconds: float) -> list[float]:
    """Return the times at which reports began to arrive."""
    times, end, buffered = [], car.now + seconds, len(car.received)
    while car.now < end:
        await car.wait(RESOLUTION_S)
        if b"$" in car.received[buffered:]:
            times.append(car.now)
        buffered = len(car.received)
    return times


async def intervals(car: VirtualStranger, seconds: float) -> list[float]:
    return [later - earlier for earlier, later in pairwise(await report_times(car, seconds))]


@pytest.mark.parametrize("interval_s", [0.71, MEASURED_S, 2.2])
async def test_trait_interval_is_seen_on_wire(interval_s: float) -> None:
    for each in await intervals(virtual(traits=CarTraits(interval_s=interval_s)), 20):
        assert each == pytest.approx(interval_s, abs=SLACK_S)


async def test_without_an_echo_the_interval_is_longer_by_the_ranging() -> None:
    car = virtual(traits=CarTraits(interval_s=MEASURED_S), world=World.open_field())
    for each in await intervals(car, 20):
        assert each == pytest.approx(MEASURED_S + 1.0, abs=SLACK_S)


@pytest.mark.parametrize("timer", [False, True])
async def test_trait_spread_bounds_intervals(timer: bool) -> None:
    found = await intervals(virtual(traits=CarTraits(interval_s=1.0, spread_s=0.08, timer=timer)), 100)
    assert 0.9 < min(found) < 0.95
    assert 1.05 < max(found) < 1.1


# The vendor's Arduino program: each frame that blocks delays the next report by just its block, and no other one.
DELAYS = [
    (MODE00, 1.0),
    (WHISTLE, 0.304),
    (PTZ90, 0.636),
    (b"$0,0,0,0,1,0,0,0,0#", 0.637),
    (COLOR, 0.101),
    (RUN, 0.0),
    (b"$0,0,0,0,0,0,2,0,0#", 0.0),
]


@pytest.mark.parametrize(("frame", "delay_s"), DELAYS)
@pytest.mark.parametrize("timer", [False, True])
async def test_blocking_frame_delays_report_unless_timer(frame: bytes, delay_s: float, timer: bool) -> None:
    car = virtual(traits=CarTraits(interval_s=MEASURED_S, timer=timer))
    before = (await report_times(car, 3.0))[-1]
    await car.write(frame)
    first, second = (await report_times(car, 4.5))[:2]
    assert first - before == pytest.approx(MEASURED_S + (0.0 if timer else delay_s), abs=SLACK_S)
    assert second - first == pytest.approx(MEASURED_S, abs=SLACK_S)


async def test_timer_reports_during_block() -> None:
    car = virtual(traits=CarTraits(interval_s=0.3, timer=True))
    await report_times(car, 1.0)
    await car.write(MODE00)
    await car.wait(0.1)
    assert len(await report_times(car, 0.8)) >= 2
    assert car.truth.blocked


async def test_timer_restarts_after_brown_out() -> None:
    car = virtual(traits=CarTraits(interval_s=0.4, timer=True))
    await car.wait(1.0)
    car.car.brown_out(car.now)
    assert await report_times(car, 0.5) == []
    assert len(await report_times(car, 1.3)) == 3


@pytest.mark.parametrize("close_s", [0.0, 0.2, 1.3])
async def test_trait_close_blocks_for_its_time(close_s: float) -> None:
    car = virtual(traits=CarTraits(interval_s=1.0, close_s=close_s))
    before = (await report_times(car, 2.5))[-1]
    await car.write(MODE00)
    assert (await report_times(car, 3.0))[0] - before == pytest.approx(1.0 + close_s, abs=SLACK_S)


async def test_trait_last_frame_wins() -> None:
    car = virtual(traits=CarTraits(last_frame_wins=True))
    await car.write(PTZ90)
    await car.until(lambda truth: truth.blocked)
    await car.write(RUN)
    await car.write(STOP)
    await car.write(b"#")  # alone it does nothing
    await car.write(b"$2,0,0,0")  # no whole frame yet, and the next frame restarts the string
    await car.until(lambda truth: not truth.blocked)
    await car.wait(0.1)
    assert not car.truth.driving
    await car.write(RUN)
    await car.until(lambda truth: truth.motor_left > 0)


async def test_first_frame_wins_without_trait() -> None:
    car = virtual()
    await car.write(PTZ90)
    await car.until(lambda truth: truth.blocked)
    await car.write(RUN)
    await car.write(STOP)
    await car.until(lambda truth: truth.driving)


async def test_trait_silent_mode_drives_without_reports() -> None:
    car = virtual(traits=CarTraits(silent_modes=frozenset({Mode.TRACKING})))
    await car.write(opening(2))
    await car.until(lambda truth: truth.mode == "tracking" and truth.driving)
    car.received.clear()
    await car.wait(3.0)
    assert not car.received
    await car.write(MODE00)
    await car.wait(1.2)
    await car.write(opening(5))
    await car.until(lambda _: b"CSB120" in car.received)


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
async def test_trait_text_follows_each_general_frame(platform: str) -> None:
    car = virtual(platform, traits=CarTraits(text=True))
    for _ in range(3):
        await car.write(STOP)
        await car.wait(0.2)
    await car.write(b"$4WD,PTZ90#")
    await car.wait(0.8)
    assert car.received.count(b"EXEC:F\r\n") == 3


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
async def test_without_readings_nothing_is_sent(platform: str) -> None:
    car = virtual(platform, traits=CarTraits(readings=False, text=True))
    await car.write(RUN)
    await car.wait(5.0)
    assert car.truth.driving
    assert not car.received


async def test_three_cells() -> None:
    volts = []
    for cells in (2, 3):
        car = virtual(traits=CarTraits(cells=cells))
        await car.until_received(46)
        found = re.search(rb"PV([0-9.]+)", car.received)
        assert found
        volts.append(float(found[1]))
    assert volts[1] == pytest.approx(1.5 * volts[0], abs=0.02)


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
async def test_other_frame_head_in_both_directions(platform: str) -> None:
    car = virtual(platform, traits=CarTraits(head="BALA"))
    await car.write(b"$BALA,PTZ90#")
    await car.wait(0.2)
    assert car.truth.servo == 90
    await car.until_received(40)
    assert b"$BALA,CSB" in car.received
    assert b"4WD" not in car.received


async def test_trait_head_is_read_in_mode_frames() -> None:
    car = virtual(traits=CarTraits(head="BALA"))
    await car.write(RUN)
    await car.wait(0.1)
    await car.write(b"$BALA,MODE21#")
    await car.until(lambda truth: truth.mode == "tracking")
    await car.write(b"$BALA,MODE00#")
    await car.until(lambda truth: truth.mode == "manual" and not truth.driving)


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
async def test_trait_fan_level_follows_frame(platform: str) -> None:
    car = virtual(platform, traits=CarTraits(fan_level=True))
    for frame, on in [(FAN, True), (FAN, True), (STOP, False), (STOP, False)]:
        await car.write(frame)
        await car.wait(1.2)
        assert car.truth.fan is on


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
@pytest.mark.parametrize(("direct", "servo"), [(False, 150), (True, 30)])
async def test_trait_ptz_direct_sets_servo_direction(platform: str, direct: bool, servo: int) -> None:
    car = virtual(platform, traits=CarTraits(ptz_direct=direct))
    await car.write(b"$4WD,PTZ30#")
    await car.wait(0.2)
    assert car.truth.servo == servo


async def test_gray_of_twelve_bits() -> None:
    ten, twelve = virtual(), virtual(traits=CarTraits(gray_max=4095))
    grays = []
    for car in (ten, twelve):
        await car.until_received(46)
        found = re.search(rb"GS([0-9]+)", car.received)
        assert found
        grays.append(int(found[1]))
    assert grays[1] == pytest.approx(4 * grays[0], abs=4)


async def test_constants_in_place_of_four_readings() -> None:
    car = virtual(traits=CarTraits(constants=True))
    await car.until_received(46)
    assert re.match(rb"\$4WD,CSB[0-9.]+,PV[0-9.]+,GS0,LF0000,HW00,GM00#", car.received)


async def test_report_with_foreign_field_is_damage() -> None:
    car = virtual(traits=CarTraits(more="TP31.5"))
    await report_times(car, 3.0)
    events = FrameSplitter().feed(bytes(car.received), car.now)
    assert len(events) >= 2
    assert {(type(each), each.raw[-8:], each.cause) for each in events} == {(Rejected, b",TP31.5#", Cause.UNKNOWN_WORD)}
