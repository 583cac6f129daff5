"""The vendor's STM32 program, on virtual time. The numbers were measured on the program, run on a computer."""

from itertools import pairwise

import pytest

from gateway.sim.model.stm32 import STM32_TRAITS
from tests.gateway.sim.model.test_traits import report_times
from tests.gateway.sim.strangers import BACK, FAN, MODE00, PTZ90, RUN, STOP, WHISTLE, VirtualStranger, opening, virtual


def stm32() -> VirtualStranger:
    return virtual("stm32")


@pytest.mark.parametrize("frame", [MODE00, WHISTLE, PTZ90, FAN, b"$4WD,CLR1,CLG2,CLB3#", opening(3) + MODE00])
async def test_stm32_frames_delay_no_report(frame: bytes) -> None:
    car = stm32()
    times = await report_times(car, 2.5)
    for _ in range(3):
        await car.write(frame)
        times += await report_times(car, 1.0)
    assert len(times) == 5
    for earlier, later in pairwise(times):
        assert later - earlier == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("frame", [MODE00, *(opening(mode) for mode in range(1, 7))])
async def test_mode_frame_turns_motors_and_led_off_without_block(frame: bytes) -> None:
    car = stm32()
    await car.wait(0.3)
    await car.write(b"$2,0,0,0,0,0,2,0,0#")
    await car.until(lambda truth: truth.driving and truth.led == "#ff0000")
    await car.write(frame)
    await car.wait(len(frame) / 960 + 0.001)
    assert car.car.motor_log[-1][1:] != (-51, -51)
    assert car.truth.led == "off"
    assert not car.truth.blocked


@pytest.mark.parametrize("mode", [2, 5, 6])
async def test_stm32_modes_send_no_reports(mode: int) -> None:
    car = stm32()
    await car.write(opening(mode))
    await car.wait(0.1)
    car.received.clear()
    await car.wait(5.0)
    assert not car.received
    await car.write(MODE00)
    await car.wait(1.2)
    assert car.received.startswith(b"$4WD,CSB")


async def test_tracking_drives() -> None:
    car = stm32()
    await car.write(opening(2))
    await car.until(lambda truth: truth.driving)


@pytest.mark.parametrize("mode", range(1, 7))
async def test_stm32_general_frame_is_obeyed_in_every_mode(mode: int) -> None:
    car = stm32()
    await car.write(opening(mode))
    await car.wait(1.2)
    await car.write(BACK)
    await car.wait(len(BACK) / 960 + 0.0005)
    assert (-51, -51) in [each[1:] for each in car.car.motor_log]


async def test_mode_loop_drives_on_after_general_stop() -> None:
    car = stm32()
    await car.write(opening(2))
    await car.until(lambda truth: truth.driving)
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving, within=0.1)
    await car.until(lambda truth: truth.driving, within=0.1)


async def test_last_of_two_frames_counts_during_report() -> None:
    car = stm32()
    await report_times(car, 1.5)
    for first, last, driving in [(RUN, STOP, False), (STOP, RUN, True)]:
        await car.until(lambda _: car.received.endswith(b"#"))
        car.received.clear()
        await car.until(lambda _: bool(car.received))  # the first piece of 20 bytes: 28 ms remain
        await car.write(first[:18])  # 19 bytes take 20 ms
        await car.write(b"#")
        await car.write(last)
        await car.wait(0.1)
        assert car.truth.driving is driving


async def test_stm32_lone_hash_does_nothing() -> None:
    car = stm32()
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)
    for _ in range(3):
        await car.write(b"#")
        await car.wait(0.2)
    assert car.truth.driving


async def test_stm32_half_frame_is_restarted_by_next() -> None:
    car = stm32()
    await car.write(b"$1,0,0,0,0")
    await car.wait(0.2)
    await car.write(STOP)
    await car.wait(0.2)
    await car.write(b"$4WD,CLR1")
    await car.wait(0.2)
    await car.write(RUN)
    await car.until(lambda truth: truth.driving, within=0.1)


async def drives_a_standing_car(offset_s: float) -> bool:
    """Send a stop, 60 ms later MODE00, `offset_s` after a report began. Return True if the car then drives."""
    car = stm32()
    began = (await report_times(car, 2.5))[-1] + 1.0 - 20 / 960  # the next report, from its first byte
    await car.wait(began + offset_s - car.now - 0.06)
    await car.write(STOP)
    await car.wait(0.06)
    await car.write(MODE00)
    await car.wait(1.26)
    return car.truth.driving


async def test_half_mode_frame_over_stop_starts_standing_car() -> None:
    # The stop is complete 40 ms before MODE00 begins. So the report must begin in between, and end in `$4W`.
    tries = [await drives_a_standing_car(offset / 2000) for offset in range(-10, 100)]
    assert 3 <= sum(tries) <= 5, "a window of two bytes, 2.1 ms"


async def test_stm32_stop_and_mode00_with_gap_start_no_motor() -> None:
    for offset in range(0, 1000, 7):
        car = stm32()
        await report_times(car, 1.5)
        await car.wait(offset / 1000)
        await car.write(STOP)
        await car.wait(19 / 960 + 0.06 + 0.05)
        await car.write(MODE00)
        await car.wait(0.5)
        assert len(car.car.motor_log) == 1


LIGHTS = [(1, "#ffffff"), (2, "#ff0000"), (3, "#0000ff"), (4, "#00ff00"), (5, "#00ff00"), (7, "#00ff00"), (8, "off")]


async def test_lights_three_and_four_are_swapped() -> None:
    car = stm32()
    for digit, led in LIGHTS:
        await car.write(b"$0,0,0,0,0,0,%d,0,0#" % digit)
        await car.wait(0.1)
        assert car.truth.led == led
    await car.write(b"$4WD,CLR255,CLG0,CLB0#")
    await car.wait(0.1)
    assert car.truth.led == "off"


async def test_speed_is_200_of_1000_in_steps_of_100() -> None:
    car = stm32()
    seen = []
    for digit in (0, 1, 1, 2, 2, 2, 2):
        await car.write(b"$1,0,0,%d,0,0,0,0,0#" % digit)
        await car.wait(0.1)
        seen.append(car.truth.motor_left)
    assert seen == [51, 76, 102, 76, 51, 26, 26]


@pytest.mark.parametrize("mode", [3, 4])
async def test_stm32_waiting_mode_obeys_close_at_once(mode: int) -> None:
    car = stm32()
    await car.write(opening(mode))
    await car.wait(3.1)
    await car.write(MODE00)
    await car.wait(len(MODE00) / 960 + 0.001)
    assert car.truth.mode == "manual"
    assert not car.truth.driving


async def test_stm32_brown_out_stops_motors_and_restarts_timer() -> None:
    car = stm32()
    await car.write(RUN)
    await car.wait(2.0)
    car.car.brown_out(car.now)
    assert not car.truth.driving
    assert await report_times(car, 1.4) == []
    assert len(await report_times(car, 2.0)) == 2


async def test_stm32_options_print_after_report() -> None:
    car = virtual("stm32", options="arm imu")
    await car.write(b"$4WD,ServoJ110,J220,J330,J440,J550,J660#")
    await car.wait(1.4)
    assert b"#$4WD,J110,J220,J330,J440,J550,J660#$4WD,MPUgx" in car.received


def test_stm32_traits() -> None:
    assert (STM32_TRAITS.interval_s, STM32_TRAITS.gray_max, STM32_TRAITS.timer) == (1.0, 4095, True)


async def test_stm32_timer_runs_on_in_modes() -> None:
    car = stm32()
    last = (await report_times(car, 1.5))[-1]
    await car.write(opening(2))
    await car.wait(last + 3.5 - car.now)
    await car.write(MODE00)
    await car.write(STOP)
    assert await report_times(car, 1.0) == [pytest.approx(last + 4.0, abs=0.01)]
