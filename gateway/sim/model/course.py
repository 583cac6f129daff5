"""A Raspberry Pi program from a training course: it knows some exact frames, ends at any other one, and sends nothing.

The program was run (docs/reference/protocol.md#programs-that-people-have). Its speed, and the frames that it knows
besides the motions, are assumptions.
"""

from math import inf
from typing import Final

from gateway.sim.model.firmware_base import BYTES_PER_S, CarBodyState, Firmware, Program, Rng, Wait, motion
from gateway.sim.model.raspberry_pi import PI_BOOT_S, PI_LIGHTS, SOCKET_BUFFER, TTY_BUFFER, Transport
from gateway.sim.model.traits import CarTraits

COURSE_PWM: Final = 128
_AT_REST: Final = "$0,0,0,0,0,0,0,0,0#"


def _with(place: int, digit: str) -> str:
    """Return the frame at rest with another digit at this place of its nine."""
    at = 2 * place - 1
    return _AT_REST[:at] + digit + _AT_REST[at + 1 :]


COURSE_FRAMES: Final = frozenset(
    {
        _AT_REST,
        *(_with(1, digit) for digit in "1234"),
        *(_with(2, digit) for digit in "12"),
        _with(3, "1"),
        *(_with(7, digit) for digit in "2348"),
    }
)
"""The frames that this program knows: a stop, one motion, a whistle, or one light."""


class CourseCar(Firmware):
    """A car with a course's Raspberry Pi program. Once the program has died, the motors stay as they were."""

    def __init__(
        self, body: CarBodyState, rng: Rng, *, transport: Transport = Transport.SERIAL, now: float = 0.0
    ) -> None:
        tcp = transport is Transport.TCP
        rate, buffer = (inf, SOCKET_BUFFER) if tcp else (BYTES_PER_S, TTY_BUFFER)
        super().__init__(body, rng, traits=CarTraits(readings=False), rate=rate, buffer=buffer, now=now)
        self._speed = COURSE_PWM
        self._string = ""

    def _reboot(self) -> Program:
        self._string = ""
        yield Wait(self._now + PI_BOOT_S)
        self._buffer.clear()
        yield from self._main()

    def _main(self) -> Program:
        while True:
            while self._buffer:
                self._string += chr(self._buffer.pop(0))
                if self._string.endswith("#"):
                    if self._string not in COURSE_FRAMES:
                        return  # a KeyError in the real program
                    self._obey(self._string)
                    self._string = ""
            yield Wait(inf, wakes=True)

    def _obey(self, frame: str) -> None:
        left, right = motion(frame)
        self._rgb = (0, 0, 0) if frame[13] == "8" else PI_LIGHTS.get(frame[13], self._rgb)
        self._drive(left * COURSE_PWM, right * COURSE_PWM)
