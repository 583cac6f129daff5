"""One command turns a servo of a Raspberry Pi car's camera by one step. The car itself would turn it to its end."""

import pytest

from gateway.control.commands import Drive, MoveServo, SetLight, Stop
from gateway.drivers.yahboom.driver import CAMERA_STEP_S
from gateway.sim.model.raspberry_pi import PAN_TILT_DEG_S, RaspberryPiCar, Transport
from schemas.words import Light, Motion, Phase, ServoAction
from tests.support.virtual import Pair

STEP_DEG = PAN_TILT_DEG_S * CAMERA_STEP_S
"""The angle of one step in the simulator."""
LATE_DEG = 5.0
"""Maximum angle by which the servo turns until the car reads the frame that ends the step."""


def camera(pair: Pair) -> dict[str, float]:
    assert isinstance(pair.car, RaspberryPiCar)
    return pair.car.camera


@pytest.mark.parametrize("transport", Transport)
@pytest.mark.parametrize(
    ("action", "axis", "sign"),
    [
        (ServoAction.VERTICAL_UP, "vertical", 1),
        (ServoAction.VERTICAL_DOWN, "vertical", -1),
        (ServoAction.HORIZONTAL_LEFT, "horizontal", 1),
        (ServoAction.HORIZONTAL_RIGHT, "horizontal", -1),
    ],
)
def test_camera_turns_by_one_step(transport: Transport, action: ServoAction, axis: str, sign: int) -> None:
    pair = Pair("raspberry_pi", transport=transport)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.at_rest, 30.0)
    pair.run(30.0)  # no later stop turns the servo off in our place
    pair.ask(MoveServo(action), identity="step")
    pair.run(5.0)
    assert sign * (camera(pair)[axis] - 90.0) == pytest.approx(STEP_DEG, abs=LATE_DEG)
    assert pair.phases("step")[-1] is Phase.SENT


@pytest.mark.parametrize("other", [SetLight(Light.RED), Stop(), MoveServo(ServoAction.VERTICAL_RESET)])
def test_other_command_during_step_leaves_nothing_turning(other: SetLight | Stop | MoveServo) -> None:
    pair = Pair("raspberry_pi", transport=Transport.TCP)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.at_rest, 30.0)
    pair.ask(MoveServo(ServoAction.VERTICAL_UP))
    pair.run(0.1)
    pair.ask(other)
    pair.run(1.0)
    turned = camera(pair)["vertical"] - 90.0
    assert turned <= STEP_DEG + LATE_DEG
    pair.run(5.0)
    assert camera(pair)["vertical"] - 90.0 == turned


def test_camera_turns_while_car_drives() -> None:
    """The frame that ends the step repeats the motion."""
    pair = Pair("raspberry_pi", transport=Transport.TCP)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.at_rest, 30.0)
    pair.ask(Drive(Motion.FORWARD, 3.0))
    pair.run(1.0)
    began = pair.now
    pair.ask(MoveServo(ServoAction.HORIZONTAL_LEFT))
    pair.run(1.0)
    assert camera(pair)["horizontal"] - 90.0 == pytest.approx(STEP_DEG, abs=LATE_DEG)
    assert pair.driven_since(began) == pytest.approx(1.0, abs=0.05)
