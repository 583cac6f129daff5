"""`find` makes a car blink and beep, and leaves the car as it was. The simulated car's truth is the judge."""

import pytest

from gateway.control.commands import Drive, Find, Led
from schemas.words import Motion, Phase
from tests.support.virtual import Pair

WHITE, COLOUR = "#ffffff", "#0a141e"


def seen(pair: Pair, seconds: float) -> list[str]:
    """Let time pass. Return the colors of the LED in order."""
    shown = [pair.car.truth.led]
    end = pair.now + seconds
    while pair.now < end:
        pair.run(0.01)
        if pair.car.truth.led != shown[-1]:
            shown.append(pair.car.truth.led)
    return shown


def beeps(pair: Pair, before: int) -> int:
    """Return the number of whistle frames after the first `before` frames."""
    return sum(data.split(b",")[2:3] == [b"1"] and data.startswith(b"$") for _, data in pair.sent[before:])


BLINKS = {"arduino": ["off", WHITE, "off"], "stm32": ["off"], "raspberry_pi": ["off", WHITE, "off"]}
"""The colors of the LED by platform. An stm32 car has no color frame, so it only beeps."""


@pytest.mark.parametrize("platform", BLINKS)
def test_find_at_rest_blinks_and_beeps_without_motion(platform: str) -> None:
    pair = Pair(platform).ready()
    moved, sent = len(pair.car.motor_log), len(pair.sent)
    pair.ask(Find(), identity="f")
    assert seen(pair, 3.0) == BLINKS[platform]
    assert beeps(pair, sent) == 2
    assert len(pair.car.motor_log) == moved, "its motors were switched"
    assert pair.phases("f")[-1] is Phase.SENT


@pytest.mark.parametrize("platform", BLINKS)
def test_find_while_driving_blinks_and_drives_on(platform: str) -> None:
    pair = Pair(platform).ready()
    pair.ask(Drive(Motion.FORWARD, 9.0))
    pair.run(2.0)
    moved, sent = len(pair.car.motor_log), len(pair.sent)
    pair.ask(Find())
    assert seen(pair, 3.0) == BLINKS[platform]
    assert beeps(pair, sent) == 2
    assert len(pair.car.motor_log) == moved, "its motors were switched"
    assert pair.car.truth.motor_left > 0
    assert pair.car.truth.motor_right > 0


def test_find_restores_led_color() -> None:
    pair = Pair().ready()
    pair.ask(Led(10, 20, 30))
    pair.run(3.0)
    pair.ask(Find())
    pair.run(0.6)
    assert pair.car.truth.led == WHITE
    pair.ask(Find())
    assert seen(pair, 5.0) == [WHITE, COLOUR, WHITE, COLOUR]


def test_find_restores_led_color_that_was_queued() -> None:
    pair = Pair().ready()
    pair.ask(Find())
    pair.ask(Led(10, 20, 30))
    pair.ask(Find())
    pair.run(6.0)
    assert pair.car.truth.led == COLOUR


def test_find_turns_white_led_dark() -> None:
    pair = Pair().ready()
    pair.ask(Led(255, 255, 255))
    pair.run(3.0)
    pair.ask(Find())
    assert seen(pair, 3.0) == [WHITE, "off", WHITE]
