"""The modes of the Arduino and STM32 programs: what a car does by itself, and the infrared remote.

"Row" in a comment means the row of that name in docs/reference/protocol.md.
"""

import re
from collections.abc import Generator
from math import inf
from typing import ClassVar, Final

from gateway.sim.model.firmware_base import (
    COLOR_BLOCK_S,
    NO_ECHO_S,
    WHISTLE_BLOCK_S,
    CarBodyState,
    Firmware,
    Program,
    Rng,
    Wait,
    bits,
)
from gateway.sim.model.ir_remote import SIGNS, Button
from gateway.sim.model.traits import CarTraits
from schemas.words import Mode

BOOT_S: Final = 0.5
AVOIDANCE_RANGINGS: Final = 5
SHARP_TURN_S: Final = 0.08
FAR_CM: Final = 500.0
"""In avoidance, the program discards a distance of this or more, as if there were no echo."""

MODE_OF_DIGIT: Final = {
    "0": Mode.MANUAL,
    "1": Mode.REMOTE_CONTROL,
    "2": Mode.TRACKING,
    "3": Mode.OBSTACLE_AVOIDANCE,
    "4": Mode.COLOR_LED,
    "5": Mode.LIGHT_SEEKING,
    "6": Mode.FOLLOWING,
}
"""The modes by the x of `MODE<x><y>`. The functions that `_run_mode_once` calls say what a car does in each."""

ARDUINO_LIGHTS: Final = {
    "1": (255, 255, 255),
    "2": (255, 0, 0),
    "3": (0, 255, 0),
    "4": (0, 0, 255),
    "5": (0, 255, 255),
    "6": (255, 0, 255),
    "7": (255, 255, 0),
    "8": (0, 0, 0),
}
_JOINTS: Final = re.compile(r"ServoJ1(\d+),J2(\d+),J3(\d+),J4(\d+),J5(\d+),J6(\d+)#")


class ModeCar(Firmware):
    """A car with modes. A subclass adds the main loop, obeys the frames and prints."""

    TRAITS: ClassVar[CarTraits] = CarTraits()
    """The traits of a car for which no traits are given."""
    BUFFER: ClassVar[int] = 64
    """Size of the receive buffer, bytes."""

    def __init__(
        self,
        body: CarBodyState,
        rng: Rng,
        *,
        options: frozenset[str] = frozenset(),
        traits: CarTraits | None = None,
        now: float = 0.0,
    ) -> None:
        super().__init__(body, rng, options=options, traits=traits or self.TRAITS, buffer=self.BUFFER, now=now)
        self._joints = [90] * 6
        self._reset_variables()

    def _reset_variables(self) -> None:
        """Set the program's variables to their values after a start."""
        self._in_frame = False
        self._complete = False
        self._pressed = None
        self._color_position = 0

    def _reboot(self) -> Program:
        # `brown_out` has reset the mode, the motion, the light and the fan, and cleared the buffers. The servo and the
        # arm stay at their positions.
        self._reset_variables()
        yield Wait(self._now + BOOT_S)
        self._buffer.clear()  # the UART is off while it boots
        yield from self._main()

    def _set_joints(self, text: str) -> bool:
        """Obey the frame of an arm; return True if the text is such a frame and the car has an arm."""
        found = _JOINTS.search(text) if "arm" in self._options else None
        if found:
            self._joints = [min(180, int(value)) for value in found.groups()]
        return found is not None

    @property
    def _is_silent(self) -> bool:
        return self._mode in self._traits.silent_modes

    def _print_and_wait(self, fields: str) -> Program:
        """Print the frame of one loop turn in modes 2, 5 and 6, and wait for the time of that turn."""
        raise NotImplementedError

    def _faster(self) -> None:
        raise NotImplementedError

    def _slower(self) -> None:
        raise NotImplementedError

    def _run_mode_once(self) -> Program:
        """Run one loop turn of the current mode, which is not mode 0."""
        match self._mode:
            case Mode.TRACKING:
                yield from self._tracking()
            case Mode.OBSTACLE_AVOIDANCE:
                yield from self._avoidance()
            case Mode.COLOR_LED:
                yield from self._color_led()
            case Mode.LIGHT_SEEKING:
                yield from self._light_seeking()
            case Mode.FOLLOWING:
                yield from self._following()
            case _:
                yield from self._remote()

    # Mode 1.

    def press(self, button: Button, now: float) -> bool:
        """Press a button; return True if the car obeys it.

        Only mode 1 reads the receiver. While the program is busy, the receiver stores one button and loses others.
        """
        self._run(now)
        if self._mode is not Mode.REMOTE_CONTROL or self._pressed is not None:
            return False
        self._pressed = button
        self._run(now)
        return True

    def _remote(self) -> Program:
        """Obey only the infrared remote (row "remote control")."""
        yield Wait(inf, wakes=True)
        button, self._pressed = self._pressed, None
        match button:
            case None:
                pass
            case Button.WHISTLE:
                yield from self._busy(WHISTLE_BLOCK_S)
            case Button.FASTER:
                self._faster()
            case Button.SLOWER:
                self._slower()
            case _:
                left, right = SIGNS[button]
                self._drive(left * self._pwm(), right * self._pwm())

    # The other modes. On an Arduino car, `_go` also sets the speed that still applies in mode 0 afterwards.

    def _go(self, left: int, right: int, speed: int) -> None:
        self._speed = speed
        self._drive(left * speed, right * speed)

    def _tracking(self) -> Program:
        line = self._body.line(self._now)
        left_outer, left_inner, right_inner, right_outer = line
        yield from self._print_and_wait(f"CSB0,PV8,GS0,LF{bits(line)},HW00,GM00")
        if (left_outer or left_inner) and right_outer:
            self._go(1, -1, 250)
            yield from self._busy(SHARP_TURN_S)
        elif left_outer and right_inner:
            self._go(-1, 1, 250)
            yield from self._busy(SHARP_TURN_S)
        elif left_outer:
            self._go(-1, 1, 150)
        elif right_outer:
            self._go(1, -1, 150)
        elif left_inner and not right_inner:
            self._go(0, 1, 220)
        elif right_inner and not left_inner:
            self._go(1, 0, 220)
        elif left_inner and right_inner:
            self._go(1, 1, 250)
        # If there is no line under any sensor, the motors stay as they were.

    def _light_seeking(self) -> Program:
        seen = self._body.light(self._now)
        yield from self._print_and_wait(f"CSB120,PV8.3,GS000,LF0000,HW00,GM{bits(seen)}")
        wheels = {(True, True): (1, 1), (True, False): (0, 1), (False, True): (1, 0), (False, False): (0, 0)}
        self._go(*wheels[seen], 200)

    def _following(self) -> Program:
        """Follow an object (row "6 following"). The frames have no `#`, and inverted bits, where 0 = object seen."""
        seen = self._body.obstacle(self._now)
        yield from self._print_and_wait(f"CSB120,PV8.3,GS000,LF0000,HW{bits((not seen[0], not seen[1]))},GM00")
        wheels = {(True, True): (1, 1), (True, False): (-1, 1), (False, True): (1, -1), (False, False): (0, 0)}
        self._go(*wheels[seen], 200)

    def _color_led(self) -> Program:
        yield from self._turn_servo(self._color_position)
        red, green, blue = (int(self._rng.random() * 255) for _ in range(3))
        self._rgb = (red, green, blue)
        yield from self._busy(COLOR_BLOCK_S)
        self._color_position = (self._color_position + 10) % 190

    def _avoidance(self) -> Program:
        cm = yield from self._distance()
        if cm < 20:
            self._blocked = True
            yield from self._maneuver()
            self._blocked = False
            return
        left, right = self._body.obstacle(self._now)
        if right and not left:
            self._go(-1, 1, 200)
            yield from self._busy(0.2)
        elif left:
            self._go(1, -1, 200)
            yield from self._busy(0.2)
        if cm > 30:
            self._rgb = ARDUINO_LIGHTS["3"]
            self._go(1, 1, 200)
        else:
            self._go(1, 1, 100)

    def _distance(self) -> Generator[Wait, None, float]:
        """Return the mean of the middle three of five rangings, after 0.1 s. Without echo, brake and measure again."""
        found = []
        for _ in range(AVOIDANCE_RANGINGS):
            while (cm := self._range()) is None or cm >= FAR_CM:
                self._drive(0, 0)
                yield from self._busy(NO_ECHO_S)
            found.append(cm)
            yield from self._busy(0.1 / AVOIDANCE_RANGINGS)
        return sum(sorted(found)[1:4]) / 3

    def _maneuver(self) -> Program:
        """Back off, measure right, left and ahead, and turn.

        Together with the ranging before it, this needs 4.2 s, or 4.3 s if there is an obstacle on all three sides.
        """
        self._rgb = ARDUINO_LIGHTS["2"]
        self._go(-1, -1, 80)
        yield from self._busy(0.08)
        self._drive(0, 0)
        seen = []
        for degrees in (0, 180, 90):
            yield from self._turn_servo(degrees)
            yield from self._busy(0.5)
            seen.append((yield from self._distance()))
        right, left, _ = seen
        if max(seen) < 10:
            self._rgb = ARDUINO_LIGHTS["6"]
            self._go(1, -1, 200)
            yield from self._busy(0.37)
        elif left >= right:
            self._rgb = ARDUINO_LIGHTS["4"]
            self._go(-1, 1, 200)
            yield from self._busy(0.28)
        else:
            self._rgb = ARDUINO_LIGHTS["6"]
            self._go(1, -1, 200)
            yield from self._busy(0.28)
        self._drive(0, 0)


def to_int(text: str) -> int:
    """Return the leading digits as a number, or 0 if there are none, as Arduino's String.toInt() does."""
    digits = re.match(r"\s*[+-]?\d{1,9}", text)
    return int(digits[0]) if digits else 0
