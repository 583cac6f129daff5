"""A course's Raspberry Pi program, on virtual time."""

import pytest

from tests.gateway.sim.strangers import BACK, MODE00, PTZ90, RUN, STOP, WHISTLE, opening, virtual


@pytest.mark.parametrize("tcp", [False, True])
async def test_course_car_drives_and_sends_nothing(tcp: bool) -> None:
    car = virtual("course", tcp=tcp)
    for frame, motors in [
        (RUN, (128, 128)),
        (BACK, (-128, -128)),
        (b"$0,1,0,0,0,0,0,0,0#", (-128, 128)),
        (STOP, (0, 0)),
    ]:
        await car.write(frame)
        await car.wait(0.1)
        assert (car.truth.motor_left, car.truth.motor_right) == motors
    await car.write(WHISTLE)
    await car.wait(10.0)
    assert car.truth.alive
    assert not car.received


@pytest.mark.parametrize("frame", [MODE00, opening(2), PTZ90, b"#", b"$1,0,1,0,0,0,0,0,0#"])
async def test_other_frame_ends_course_program_with_motors_unchanged(frame: bytes) -> None:
    car = virtual("course")
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)
    await car.write(frame)
    await car.until(lambda truth: not truth.alive)
    await car.write(STOP)
    await car.wait(2.0)
    assert car.truth.driving


async def test_course_car_restarts_after_brown_out() -> None:
    car = virtual("course")
    await car.write(RUN)
    await car.write(MODE00)
    await car.until(lambda truth: not truth.alive)
    car.car.brown_out(car.now)
    await car.wait(3.0)
    assert not car.truth.driving
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)
