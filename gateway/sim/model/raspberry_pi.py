"""The two programs of the Raspberry Pi car: a TCP server, and a program for a Bluetooth module. Neither has modes."""

from collections.abc import Generator
from enum import StrEnum
from math import inf
from typing import Final

from gateway.sim.model.firmware_base import (
    BYTES_PER_S,
    COLOR_BLOCK_S,
    WHISTLE_BLOCK_S,
    CarBodyState,
    Firmware,
    Program,
    Rng,
    Wait,
    bits,
    motion,
)
from gateway.sim.model.traits import CarTraits

TCP_RECEIVE: Final = 128
"""Maximum number of bytes in one call of receive."""
SOCKET_BUFFER: Final = 65536
TTY_BUFFER: Final = 4096
TCP_START_PERCENT: Final = 80
SERIAL_START_PERCENT: Final = 50
FAN_S: Final = 1.0
LIGHT_S: Final = 0.02
PI_BOOT_S: Final = 2.0
GREETING: Final = b"serial is on!"
PAN_TILT_DEG_S: Final = 35.0

PI_LIGHTS: Final = {"2": (255, 0, 0), "3": (0, 255, 0), "4": (0, 0, 255)}
CYCLE: Final = (
    (255, 255, 255),
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
    (255, 255, 0),
    (0, 255, 255),
    (255, 0, 255),
    (0, 0, 0),
)
_TURNS: Final = {"3": ("vertical", 1), "4": ("vertical", -1), "6": ("horizontal", 1), "7": ("horizontal", -1)}
_RESETS: Final = {"5": "vertical", "8": "horizontal"}
_LIMITS: Final = {"vertical": (45.0, 180.0), "horizontal": (0.0, 180.0)}


class Transport(StrEnum):
    """The connection of the program to its host. The two programs read differently."""

    TCP = "tcp"
    SERIAL = "serial"


class _Died(Exception):
    """The program has ended with an error. The motors stay as they were."""


class RaspberryPiCar(Firmware):
    """A car with one of the vendor's Raspberry Pi programs. Options: `arm`, `imu`."""

    def __init__(
        self,
        body: CarBodyState,
        rng: Rng,
        *,
        transport: Transport = Transport.TCP,
        options: frozenset[str] = frozenset(),
        traits: CarTraits | None = None,
        now: float = 0.0,
    ) -> None:
        tcp = transport is Transport.TCP
        rate, buffer = (inf, SOCKET_BUFFER) if tcp else (BYTES_PER_S, TTY_BUFFER)
        super().__init__(body, rng, options=options, traits=traits, rate=rate, buffer=buffer, now=now)
        self._tcp = tcp
        self._camera = {"vertical": 90.0, "horizontal": 90.0}
        self._joints = [90] * 6
        self._reset_variables()

    def _reset_variables(self) -> None:
        self._cache = ""
        self._in_frame = False
        self._speed = TCP_START_PERCENT if self._tcp else SERIAL_START_PERCENT
        self._cycle = 0
        self._turning: tuple[str, int, float] | None = None
        self._client = False
        self._client_gone = False
        self._due = {"report": self._next_interval_s(self._traits.loop_s)}
        for offset, option in ((0.3, "arm"), (0.6, "imu")):
            if option in self._options:
                self._due[option] = offset

    def connected(self, now: float) -> None:
        """Record that a TCP client has connected."""
        self._run(now)
        self._client = True

    def disconnected(self, now: float) -> None:
        """Record that the TCP client is gone. The next report ends the program, even if a client has reconnected."""
        self._run(now)
        self._client_gone = True

    @property
    def camera(self) -> dict[str, float]:
        """The angles of the camera's vertical and horizontal servos, degrees."""
        self._settle()
        return dict(self._camera)

    def drop_link(self, now: float) -> None:
        """Cut the link. Over TCP, the program can still read bytes that have reached the machine."""
        super().drop_link(now)
        if self._tcp and self._client:
            self.disconnected(now)

    def _reboot(self) -> Program:
        # On a real car somebody must start the program, unless it is a service. In the simulator it starts by itself.
        self._reset_variables()
        yield Wait(self._now + PI_BOOT_S)
        self._buffer.clear()
        yield from self._main()

    def _pwm(self) -> int:
        return round(255 * self._speed / 100)

    def _main(self) -> Program:
        if not self._tcp:
            self._send(GREETING)
        try:
            while True:
                text = self._receive_tcp() if self._tcp else self._receive_serial()
                if text is not None:
                    yield from self._parse(text)
                elif not self._buffer:
                    yield from self._idle()
        except _Died:
            return

    # From the host.

    def _receive_tcp(self) -> str | None:
        """Receive once. If the text begins with `$` and contains a `#`, return it whole; otherwise ignore it whole."""
        data = self._buffer[:TCP_RECEIVE].decode("latin-1")
        del self._buffer[:TCP_RECEIVE]
        return data if data.startswith("$") and "#" in data else None

    def _receive_serial(self) -> str | None:
        """Read all buffered bytes and return the last whole frame. Store a truncated frame until its rest arrives."""
        last = None
        for byte in self._buffer:
            char = chr(byte)
            if char == "$":
                self._in_frame = True
            if self._in_frame:
                self._cache += char
                if char == "#":
                    last, self._cache, self._in_frame = self._cache, "", False
        self._buffer.clear()
        return last

    def _parse(self, text: str) -> Program:
        servo: int | None = None
        head = "$" + self._traits.head
        if f"{head},PTZ" in text:
            servo = self._servo_deg(_number(text, "PTZ", "#"))
        if "CLR" in text:
            self._rgb = (_number(text, "CLR", ",CLG"), _number(text, "CLG", ",CLB"), _number(text, "CLB", "#"))
            yield from self._busy(COLOR_BLOCK_S)
        if "arm" in self._options and "ServoJ1" in text:
            ends = [*(f",J{n}" for n in range(2, 7)), "#"]
            self._joints = [min(180, _number(text, f"J{n}", end)) for n, end in enumerate(ends, 1)]
        if head not in text:
            servo = yield from self._general_frame(text)
        if servo is not None:
            yield from self._turn_servo(servo)

    def _general_frame(self, text: str) -> Generator[Wait, None, int | None]:
        """Whistle and run the fan, then set the motion.

        Return the target of the front servo, which moves last, or None.
        """
        if len(text) < 18:
            raise _Died  # the program reads place 9, here text[17], without checking that it exists
        left, right = motion(text)
        if text[5] == "1":
            yield from self._busy(WHISTLE_BLOCK_S)
        if text[7] == "1":
            self._speed = min(100, self._speed + 20)
        elif text[7] == "2":
            self._speed = max(20, self._speed - 20)
        if text[13] == "1":
            self._rgb = CYCLE[self._cycle]
            self._cycle = (self._cycle + 1) % len(CYCLE)
            yield from self._busy(LIGHT_S)
        elif text[13] in PI_LIGHTS:
            self._rgb = PI_LIGHTS[text[13]]
            yield from self._busy(LIGHT_S)
        self._set_fan(text[15])
        if text[15] == "1":
            yield from self._busy(FAN_S)
        self._turn_camera(text[9])
        pwm = self._pwm()
        self._drive(left * pwm, right * pwm)
        self._print_text()
        return 90 if text[17] == "1" else {"1": 180, "2": 0}.get(text[9])

    def _turn_camera(self, digit: str) -> None:
        """Turn the camera until another general frame changes it."""
        self._settle()
        axis, sign = _TURNS.get(digit, ("", 0))
        self._turning = (axis, sign, self._now) if axis else None
        if digit in _RESETS and not (self._tcp and digit == "8"):  # over TCP, 8 only stops both servos
            self._camera[_RESETS[digit]] = 90.0

    def _settle(self) -> None:
        if self._turning is not None:
            axis, sign, since = self._turning
            low, high = _LIMITS[axis]
            turned = self._camera[axis] + sign * PAN_TILT_DEG_S * (self._now - since)
            self._camera[axis] = min(high, max(low, turned))
            self._turning = (axis, sign, self._now)

    # To the host.

    def _idle(self) -> Program:
        since = self._now
        due = since + min(self._due.values())
        yield Wait(due, wakes=True)
        for what in self._due:
            self._due[what] -= self._now - since
        if self._now >= due:
            what = min(self._due, key=lambda name: self._due[name])
            self._due[what] = self._next_interval_s(self._traits.loop_s)
            yield from self._report(what)

    def _report(self, what: str) -> Program:
        if what == "arm":
            frame = self._arm_frame(self._joints)
        elif what == "imu":
            frame = self._imu_frame()
        else:
            cm = yield from self._ranging()
            now, body = self._now, self._body
            frame = self._frame(
                f"CSB{int(cm or 0)},PV{4.2 * self._traits.cells:.1f},GS0,"
                f"LF{bits(body.line(now))},HW{bits(body.obstacle(now))},GM{bits(body.light(now))}"
            )
        if self._tcp:
            if self._client_gone:
                raise _Died
            if not self._client:
                return
        self._send(frame)


def _number(text: str, word: str, end: str) -> int:
    """Return the number between the FIRST occurrences of two words. If there is no number, the program dies."""
    start, stop = text.find(word) + len(word), text.find(end)
    if stop < start or not text[start:stop].strip().lstrip("+-").isdecimal():
        raise _Died
    return min(255, max(0, int(text[start:stop])))
