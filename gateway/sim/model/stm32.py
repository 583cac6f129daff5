"""The vendor's STM32 program: a report by a timer, one buffer that an interrupt fills, and frames that never block.

The program was run on a computer, with its interrupts (docs/reference/protocol.md#programs-that-people-have). Three
things were not measured: the slowest speed, the time of a loop turn in a silent mode, and the speeds of the modes. The
speeds of the modes here are those of the Arduino program.
"""

from typing import ClassVar, Final

from gateway.sim.model.firmware_base import Program, Wait, motion
from gateway.sim.model.mode_car import MODE_OF_DIGIT, ModeCar, to_int
from gateway.sim.model.traits import CarTraits
from schemas.words import Mode

STM32_TRAITS: Final = CarTraits(
    interval_s=1.0,
    timer=True,
    close_s=0.0,
    last_frame_wins=True,
    silent_modes=frozenset({Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING}),
    gray_max=4095,
)
"""The traits of this program. It ignores other values of `timer`, `close_s` and `last_frame_wins`."""
FRAME_BUFFER: Final = 80
"""Size of the buffer that the interrupt fills. Further bytes are dropped until the next `$`."""
STM32_START_SPEED: Final = 200
STM32_SPEED_STEP: Final = 100
STM32_TOP_SPEED: Final = 1000
SILENT_TURN_S: Final = 0.02
"""Time of one loop turn of a mode that prints nothing."""
# The program does not know lights 5 to 7. Its lights 3 and 4 are swapped, compared with docs/reference/protocol.md.
STM32_LIGHTS: Final = {"1": (255, 255, 255), "2": (255, 0, 0), "3": (0, 0, 255), "4": (0, 255, 0), "8": (0, 0, 0)}


class _TurnEnded(Exception):
    """A MODE frame has ended the loop turn of the mode that was running."""


class Stm32Car(ModeCar):
    """A car with the vendor's STM32 program. Options: `arm`, `imu`."""

    TRAITS: ClassVar[CarTraits] = STM32_TRAITS
    BUFFER: ClassVar[int] = 4096
    """The interrupt reads each byte at once, so no byte is lost."""

    def _reset_variables(self) -> None:
        super()._reset_variables()
        self._memory = ["\0"] * FRAME_BUFFER
        self._index = 0
        self._speed = STM32_START_SPEED
        self._is_report_due = False

    def _main(self) -> Program:
        self._alarm_at = self._now + self._next_interval_s(self._traits.interval_s)
        while True:
            try:
                self._obey_buffer()
                if self._mode is Mode.MANUAL:
                    yield from self._manual()
                else:
                    yield from self._run_mode_once()
            except _TurnEnded:
                continue

    def _on_alarm(self) -> None:
        self._alarm_at += self._next_interval_s(self._traits.interval_s)
        self._is_report_due = self._mode is Mode.MANUAL

    def _pwm(self) -> int:
        return round(255 * self._speed / STM32_TOP_SPEED)

    def _faster(self) -> None:
        self._speed = min(STM32_TOP_SPEED, self._speed + STM32_SPEED_STEP)

    def _slower(self) -> None:
        self._speed = max(STM32_SPEED_STEP, self._speed - STM32_SPEED_STEP)

    def _busy(self, seconds: float) -> Program:
        """Wait in a turn of a mode. Frames are obeyed meanwhile, and a MODE frame ends the turn."""
        end = self._now + seconds
        while self._now < end and self._mode is not Mode.REMOTE_CONTROL:  # this mode does not wait for anything
            yield Wait(end, wakes=True)
            self._obey_buffer()

    # From the host.

    def _interrupt(self) -> None:
        """Put the received bytes into the one buffer. From a `$` on, they overwrite it from its beginning."""
        for byte in self._buffer:
            char = chr(byte)
            if char == "$":
                self._in_frame, self._index = True, 0
            if self._in_frame and self._index < FRAME_BUFFER:
                self._memory[self._index] = char
                self._index += 1
            if char == "#" and self._in_frame:
                self._in_frame, self._complete = False, True
        self._buffer.clear()

    def _obey_buffer(self) -> None:
        """Obey the buffer if a frame has become complete since the last call, whatever is in the buffer now.

        If another frame has begun since then, its beginning has overwritten that of the complete frame. This call
        clears the buffer with that beginning. The rest of the new frame arrives later and is put behind the cleared
        place. So the program then reads an empty string.
        """
        self._interrupt()
        if not self._complete:
            return
        text = "".join(self._memory).partition("\0")[0]
        self._memory = ["\0"] * FRAME_BUFFER
        self._complete = False
        if self._traits.head in text:
            self._named_frame(text)
        elif text:
            self._general_frame(text)

    def _named_frame(self, text: str) -> None:
        if "MODE" in text:
            self._mode_frame(text)
        elif (at := text.find("PTZ")) > 0:
            self._servo = min(180, max(0, self._servo_deg(to_int(text[at + 3 :]))))
        else:
            self._set_joints(text)

    def _mode_frame(self, text: str) -> None:
        place = len(self._traits.head) + 6
        digit = text[place : place + 1]
        if text[place + 1 : place + 2] == "0":
            self._mode = Mode.MANUAL
        elif digit in MODE_OF_DIGIT:
            self._mode = MODE_OF_DIGIT[digit]
        else:
            return
        self._pressed = None
        self._drive(0, 0)
        self._rgb = (0, 0, 0)
        raise _TurnEnded

    def _general_frame(self, text: str) -> None:
        """Obey a general frame, in every mode. Nothing in it blocks."""
        left, right = motion(text)
        if text[7:8] == "1":
            self._faster()
        elif text[7:8] == "2":
            self._slower()
        self._servo = {"1": 180, "2": 0}.get(text[9:10], self._servo)
        self._rgb = STM32_LIGHTS.get(text[13:14], self._rgb)
        self._set_fan(text[15:16])
        if text[17:18] == "1":
            self._servo = 90
        pwm = self._pwm()
        self._drive(left * pwm, right * pwm)
        self._print_text()

    # To the host.

    def _manual(self) -> Program:
        yield Wait(self._alarm_at, wakes=True)
        if not self._is_report_due:
            return
        self._is_report_due = False
        if self._is_silent:
            return
        self._send(self._report_frame(self._range()))
        if "arm" in self._options:
            self._send(self._arm_frame(self._joints))
        if "imu" in self._options:
            self._send(self._imu_frame())
        # The main loop waits until each byte is sent, and does not read the buffer meanwhile.
        yield Wait(max(self._now, self._tx_free))

    def _print_and_wait(self, fields: str) -> Program:
        if self._is_silent:
            yield from self._busy(SILENT_TURN_S)
        else:
            self._send(self._frame(fields))
            yield Wait(max(self._now + SILENT_TURN_S, self._tx_free))

    def _go(self, left: int, right: int, speed: int) -> None:
        self._drive(left * speed, right * speed)
