"""The infrared remote takes a car over in mode 1 only."""

import pytest

from gateway.sim.model.ir_remote import SIGNS, Button
from tests.gateway.sim.strangers import FAN, MODE00, RUN, STOP, WHISTLE, VirtualStranger, opening, opening_s, virtual


async def in_mode(mode: int, platform: str = "arduino") -> VirtualStranger:
    car = virtual(platform)
    await car.wait(0.2)
    if mode:
        await car.write(opening(mode))
        await car.wait(opening_s(mode) + 0.2)
    return car


@pytest.mark.parametrize(("platform", "pwm"), [("arduino", 150), ("stm32", 51)])
@pytest.mark.parametrize("button", SIGNS)
async def test_in_remote_control_it_drives_and_the_motion_holds(platform: str, pwm: int, button: Button) -> None:
    car = await in_mode(1, platform)
    assert car.car.press(button, car.now)
    left, right = SIGNS[button]
    for _ in range(100):
        await car.wait(0.1)
        assert (car.truth.motor_left, car.truth.motor_right) == (left * pwm, right * pwm)
    assert car.car.press(Button.STOP, car.now)
    assert not car.truth.driving
    assert not car.received, "remote control is silent"


async def test_in_remote_control_nobody_else_drives() -> None:
    car = await in_mode(1)
    car.car.press(Button.SPIN_LEFT, car.now)
    for frame in (STOP, RUN, FAN):
        await car.write(frame)
        await car.wait(2.0)
        assert (car.truth.motor_left, car.truth.motor_right) == (-150, 150)
    await car.write(MODE00)
    await car.until(lambda truth: not truth.driving)
    await car.wait(1.5)
    assert not car.car.press(Button.FORWARD, car.now)
    await car.wait(3.0)
    assert car.truth.mode == "manual"
    assert not car.truth.driving


@pytest.mark.parametrize("mode", [0, 2, 3, 4, 5, 6])
async def test_other_modes_do_not_see_it(mode: int) -> None:
    unpressed, pressed = await in_mode(mode), await in_mode(mode)
    for number, button in enumerate([*Button, *Button]):
        assert not pressed.car.press(button, pressed.now), number
        await pressed.wait(0.13)
        await unpressed.wait(0.13)
        assert pressed.truth == unpressed.truth
    assert pressed.received == unpressed.received


async def test_raspberry_pi_does_not_see_it() -> None:
    car = virtual("raspberry_pi")
    assert not car.car.press(Button.FORWARD, car.now)
    await car.wait(3.0)
    assert not car.truth.driving


async def test_first_press_during_mode_opening_is_obeyed_later() -> None:
    car = virtual()
    await car.wait(0.2)
    await car.write(opening(1))
    await car.wait(1.0)
    assert car.car.press(Button.FORWARD, car.now)
    assert not car.car.press(Button.BACK, car.now)
    assert not car.truth.driving
    await car.until(lambda truth: truth.driving)
    assert car.truth.motor_left == 150
    assert 0.2 + opening_s(1) <= car.now <= 0.2 + opening_s(1) + 0.1


async def test_press_that_a_close_overtakes_is_forgotten() -> None:
    car = await in_mode(1)
    assert car.car.press(Button.WHISTLE, car.now)  # busy for 0.3 s
    assert car.car.press(Button.FORWARD, car.now)
    await car.write(MODE00)
    await car.wait(10.0)
    assert car.truth.mode == "manual"
    assert not car.truth.driving
    assert car.received.count(b"#") >= 6, "mode 0 reports as it should"


async def test_speed_and_whistle() -> None:
    car = await in_mode(1)
    for button, speed in ((Button.FASTER, 200), (Button.FASTER, 250), (Button.FASTER, 255), (Button.SLOWER, 205)):
        assert car.car.press(button, car.now)
        assert car.truth.speed == speed
    car.car.press(Button.FORWARD, car.now)
    assert car.truth.motor_left == 205
    car.car.press(Button.WHISTLE, car.now)
    assert car.truth.blocked
    assert car.truth.driving
    await car.wait(0.31)
    assert not car.truth.blocked


async def test_reset_forgets_a_press() -> None:
    car = await in_mode(1)
    car.car.press(Button.WHISTLE, car.now)
    car.car.press(Button.FORWARD, car.now)
    car.car.brown_out(car.now)
    await car.write(WHISTLE)
    await car.wait(5.0)
    assert not car.truth.driving
