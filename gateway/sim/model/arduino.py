"""The program of the Arduino car: one loop, one string for all received bytes, and modes.

Other traits turn it into another car of the family.

It reads its string by position, as the real program does, and does not use our codec. "Row" in a comment means the row
of that name in docs/reference/protocol.md.
"""

from collections.abc import Generator
from math import inf
from typing import Final

from gateway.sim.model.firmware_base import COLOR_BLOCK_S, WHISTLE_BLOCK_S, Program, Wait, motion
from gateway.sim.model.mode_car import ARDUINO_LIGHTS, MODE_OF_DIGIT, ModeCar, to_int
from schemas.words import Mode

TX_BUFFER: Final = 64
# A car that got a named frame it does not know never clears its string. In the real program, the string grows until the
# RAM is full.
STRING_LIMIT: Final = 512
"""Maximum length of the string. Further bytes are dropped."""
START_SPEED: Final = 150
OPEN_S: Final = 2.0
BEEP_S: Final = 0.1
LIGHT_TURN_S: Final = 0.107
"""Duration of one loop turn in light seeking: the measured interval of its reports."""


class ArduinoCar(ModeCar):
    """A car with the vendor's Arduino program. Options: `arm`, `imu`."""

    def _reset_variables(self) -> None:
        super()._reset_variables()
        self._string = ""
        self._arriving = ""
        """The frame that is arriving, in a car with `last_frame_wins`: there a `$` restarts the string."""
        self._speed = START_SPEED
        self._prints_from = -inf
        """The time from which the open mode prints its readings."""
        # The program counts turns of its loop, so these times stand still while it blocks. The frames of the options
        # are sent between the reports, so that none of them has to wait for room in the transmit buffer.
        self._due: dict[str, float] = {}
        """Loop time until each frame of mode 0."""
        if not self._traits.timer:
            self._due["report"] = self._next_interval_s(self._traits.loop_s)
        for offset, option in ((0.3, "arm"), (0.6, "imu")):
            if option in self._options:
                self._due[option] = offset

    def _main(self) -> Program:
        if self._traits.timer:
            self._alarm_at = self._now + self._next_interval_s(self._traits.interval_s)
        while True:
            self._serial_event()
            if self._complete and (yield from self._parse()):
                continue  # bytes that arrived while a mode was opened are obeyed right after that, not a turn later
            if self._mode is Mode.MANUAL:
                yield from self._manual()
            else:
                yield from self._run_mode_once()

    # From the host.

    def _serial_event(self) -> None:
        """Append the bytes of all buffered frames to ONE string.

        `#` completes it even outside a frame (row "a lone #").
        """
        if self._traits.last_frame_wins:
            self._keep_last()
            return
        for byte in self._buffer:
            char = chr(byte)
            if char == "$":
                self._in_frame = True
            if self._in_frame and len(self._string) < STRING_LIMIT:
                self._string += char
            if char == "#":
                self._complete = True
                self._in_frame = False
        self._buffer.clear()

    def _keep_last(self) -> None:
        """Store only the last whole frame of the buffered bytes. A `#` outside a frame does nothing."""
        for byte in self._buffer:
            char = chr(byte)
            if char == "$":
                self._in_frame, self._arriving = True, ""
            if self._in_frame and len(self._arriving) < STRING_LIMIT:
                self._arriving += char
            if char == "#" and self._in_frame:
                self._string, self._complete, self._in_frame = self._arriving, True, False
        self._buffer.clear()

    def _parse(self) -> Generator[Wait, None, bool]:
        """Obey the string if the program knows it. Return True if this cleared the string."""
        text, head = self._string, self._traits.head
        if text.find("MODE") > 0 and text.find(head) > 0:
            yield from self._mode_frame(text)
        elif self._mode is not Mode.MANUAL:
            pass  # row "a general stop in a mode other than 0"
        elif not (yield from self._named_frame(text)):
            if head in text:
                return False  # row "a named frame it does not know": neither obeyed nor cleared
            yield from self._general_frame(text)
        self._string = ""
        self._complete = False
        return True

    def _mode_frame(self, text: str) -> Program:
        """Read the characters at places 9 and 10 of the string (with a head of three letters), whatever they are."""
        self._pressed = None
        place = len(self._traits.head) + 6
        if text[place + 1 : place + 2] == "0":
            self._drive(0, 0)
            self._mode = Mode.MANUAL
            yield from self._busy(self._traits.close_s)
            return
        digit = text[place : place + 1]
        self._mode = MODE_OF_DIGIT.get(digit, Mode.MANUAL)
        # Row "a mode opened while driving": nothing here touches the motors.
        beeps = BEEP_S + 0.2 * (int(digit) + 1) if digit in MODE_OF_DIGIT else 0.0
        yield from self._busy(beeps + OPEN_S)
        self._prints_from = self._now + self._traits.first_reading_s

    def _general_frame(self, text: str) -> Program:
        """Set the motion last, after everything that blocks, as in the real program."""
        left, right = motion(text)
        if text[5:6] == "1":
            yield from self._busy(WHISTLE_BLOCK_S)
        if text[7:8] == "1":
            self._faster()
        elif text[7:8] == "2":
            self._slower()
        if text[9:10] == "1":
            yield from self._turn_servo(180)
        elif text[9:10] == "2":
            yield from self._turn_servo(0)
        self._rgb = ARDUINO_LIGHTS.get(text[13:14], self._rgb)
        self._set_fan(text[15:16])
        if text[17:18] == "1":
            yield from self._turn_servo(90)
        self._drive(left * self._speed, right * self._speed)
        self._print_text()

    def _faster(self) -> None:
        self._speed = min(255, self._speed + 50)

    def _slower(self) -> None:
        slower = self._speed - 50
        self._speed = 100 if slower < 50 else slower

    def _named_frame(self, text: str) -> Generator[Wait, None, bool]:
        """Obey a named frame; return True if it is known."""
        if (at := text.find("PTZ")) > 0:
            end = text.find("#", at)
            if end > at:
                yield from self._turn_servo(self._servo_deg(to_int(text[at + 3 : end])))
                return True
        elif text.find("CLR") > 0:
            red, green, blue = (_field(text, word) for word in ("CLR", "CLG", "CLB"))
            if blue is not None:
                old = self._rgb
                self._rgb = (
                    old[0] if red is None else red,
                    old[1] if green is None else green,
                    blue,
                )
                yield from self._busy(COLOR_BLOCK_S)
                return True
        return self._set_joints(text)

    # Mode 0.

    def _manual(self) -> Program:
        """Wait for a byte, or send the next frame.

        While the fan runs, loop turns do not count, so only a hardware timer sends reports.
        """
        since = self._now
        due = inf if self._fan else since + min(self._due.values(), default=inf)
        yield Wait(due, wakes=True)
        if self._fan:
            return
        for what in self._due:
            self._due[what] -= self._now - since
        if self._now >= due:
            what = min(self._due, key=lambda name: self._due[name])
            self._due[what] = self._next_interval_s(self._traits.loop_s)
            yield from self._report(what)

    def _report(self, what: str) -> Program:
        if what == "arm":
            self._send(self._arm_frame(self._joints))
        elif what == "imu":
            self._send(self._imu_frame())
        else:
            cm = yield from self._ranging()
            if not self._is_silent:
                yield from self._print(self._report_frame(cm))

    def _on_alarm(self) -> None:
        """Report by the timer, also during a block. The ranging for this report does not block the program."""
        self._alarm_at += self._next_interval_s(self._traits.interval_s)
        if self._mode is Mode.MANUAL and not self._is_silent:
            self._send(self._report_frame(self._range()))

    def _print(self, data: bytes) -> Program:
        """Send a frame; block while the 64-byte transmit buffer is full."""
        room_at = self._tx_free - (TX_BUFFER - len(data)) / self._rate
        if room_at > self._now:
            yield Wait(room_at)
        self._send(data)

    def _print_and_wait(self, fields: str) -> Program:
        """Send the frame of one loop turn in modes 2, 5 and 6, at the rate of the UART."""
        frame = self._frame(fields)
        if self._mode is Mode.FOLLOWING:
            frame = frame[:-1]  # row "6 following": no `#`
        if self._fan or self._is_silent or not self._traits.readings or self._now < self._prints_from:
            yield Wait(self._now + len(frame) / self._rate)
        else:
            yield from self._print(frame)

    def _light_seeking(self) -> Program:
        began = self._now
        yield from super()._light_seeking()
        yield Wait(max(self._now, began + LIGHT_TURN_S))


def _field(text: str, word: str) -> int | None:
    """Return the number after a word of a color frame, 0..255. None if the number or its end is missing."""
    at = text.find(word)
    end = text.find("#" if word == "CLB" else ",", at) if at >= 0 else -1
    return min(255, max(0, to_int(text[at + 3 : end]))) if end > at else None
