"""The base of every program but the one in `ugv`: one blocking loop on virtual time, a UART each way, motors.

A program is a generator that yields a `Wait` wherever the real program blocks, so that the code of both looks alike.
`arduino`, `stm32`, `raspberry_pi` and `course` have the programs, `traits` their parameters, `car_body` the motion and
the sensors.
"""

from collections import deque
from collections.abc import Generator
from math import ceil, inf
from typing import Final, NamedTuple, Protocol, TypeAlias

from msgspec import Struct

from gateway.sim.model.ir_remote import Button
from gateway.sim.model.scheduler import EventScheduler
from gateway.sim.model.traits import CarTraits
from schemas.words import Mode

# The numbers below repeat those of gateway.drivers.yahboom.protocol on purpose: the simulator is the oracle of the
# tests, and an oracle that shared its numbers with the tested code could not find a wrong number.

BYTES_PER_S: Final = 960.0
"""9600 baud, 8N1: ten bits a byte (docs/reference/protocol.md#framing)."""
CHUNK: Final = 20
"""Maximum number of bytes in a piece, as from a Bluetooth 4.0 module."""

# As measured on the vendor's Arduino program (docs/reference/protocol.md#programs-that-people-have).
WHISTLE_BLOCK_S: Final = 0.304
SERVO_BLOCK_S: Final = 0.637
COLOR_BLOCK_S: Final = 0.101
# The vendor's Arduino program was measured at about 0.68 s. The 1.0 s of docs/reference/protocol.md is the worst case.
NO_ECHO_S: Final = 1.0
ECHO_S_PER_CM: Final = 58e-6
"""Time of the sound for 1 cm of distance, there and back."""
REPORT_BASE_S: Final = 0.004
TEXT_LINE: Final = b"EXEC:F\r\n"


class Rng(Protocol):
    """A seeded source of random numbers; `random.Random` is one."""

    def random(self) -> float:
        """Return the next number in 0..1."""


class Pose(NamedTuple):
    """The pose of a car (REP-103: x forward, y left, counter-clockwise)."""

    x_m: float
    y_m: float
    heading_rad: float


class CarBodyState(Protocol):
    """The motors and sensors of a car, for its program."""

    def drive(self, now: float, left: int, right: int) -> None:
        """Set the PWM values of the motors from `now` on, -255..255."""

    def pose(self, now: float) -> Pose:
        """Return the true pose."""

    def range_cm(self, now: float, bearing_deg: float) -> float | None:
        """Return the ultrasonic distance at a bearing from straight ahead, left positive. None without echo."""

    def line(self, now: float) -> tuple[bool, bool, bool, bool]:
        """Return whether each sensor sees the line: left-outer, left-inner, right-inner, right-outer."""

    def obstacle(self, now: float) -> tuple[bool, bool]:
        """Return whether the left and the right infrared sensor see an obstacle."""

    def light(self, now: float) -> tuple[bool, bool]:
        """Return whether the left and the right sensor see light."""

    def grayscale(self, now: float) -> int:
        """Return the raw ADC value of the floor, 0..1023."""

    def drain(self, now: float, in_s: float) -> None:
        """Let the battery run empty within a time."""

    def battery_v(self, now: float) -> float:
        """Return the battery voltage."""

    def yaw_rate_deg_s(self, now: float) -> float:
        """Return the yaw rate, left positive."""


class Truth(Struct, frozen=True):
    """The true state of a simulated car."""

    mode: Mode
    motor_left: int
    motor_right: int
    blocked: bool
    """True while the program is blocked for 0.1 s or more, so that received bytes pile up."""
    fan: bool
    led: str
    """`off`, or `#rrggbb`."""
    servo: int
    """Direction of the front servo, 0..180 degrees; 90 is straight ahead, 180 left."""
    speed: int
    """The PWM value (0..255) at which the next motion drives."""
    alive: bool
    """False once a Raspberry Pi program has died, until a brownout starts it again."""

    @property
    def driving(self) -> bool:
        """True if a motor is on."""
        return self.motor_left != 0 or self.motor_right != 0


class Wait(Struct, frozen=True):
    """A block of the program until `until`, or until the next byte if a byte `wakes` it."""

    until: float
    wakes: bool = False


Program: TypeAlias = Generator[Wait, None, None]


class Firmware:
    """One car's program and its wires on virtual time: `feed` bytes, `advance`, read `truth`.

    Times are seconds from any origin and must not run backwards.
    """

    def __init__(
        self,
        body: CarBodyState,
        rng: Rng,
        *,
        options: frozenset[str] = frozenset(),
        traits: CarTraits | None = None,
        rate: float = BYTES_PER_S,
        buffer: int = 64,
        now: float = 0.0,
    ) -> None:
        self._body = body
        self._rng = rng
        self._options = options
        self._traits = traits or CarTraits()
        self._rate = rate
        self._limit = buffer
        self._now = now
        self._arrivals: deque[tuple[float, int]] = deque()
        self._buffer = bytearray()
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self._tx_free = now
        self._left = self._right = 0
        self._blocked = False
        self._alive = True
        self._mode = Mode.MANUAL
        self._fan = False
        self._servo = 90
        self._speed = 0
        self._rgb = (0, 0, 0)
        self.motor_log: deque[tuple[float, int, int]] = deque([(now, 0, 0)], maxlen=4096)
        """(time, left, right) of the last 4096 changes of the motors, oldest first."""
        self.lost_bytes = 0
        """Number of bytes dropped because the receive buffer was full."""
        self._pressed: Button | None = None
        """A button of the remote that was pressed and that the program has not read yet."""
        self.scheduler: EventScheduler | None = None
        """Runs the programs of all cars in the order of time. None if cars do not affect each other."""
        self._alarm_at = inf
        """Time of the next interrupt by a hardware timer, or inf without a timer."""
        self._program = self._main()
        self._wait = Wait(now)

    def _main(self) -> Program:
        raise NotImplementedError

    # The calls of the simulation.

    def feed(self, data: bytes, now: float) -> None:
        """Put bytes on the link at `now`; they reach the car at the rate of its UART."""
        self._run(now)
        at = max(now, self._arrivals[-1][0] if self._arrivals else now)
        for byte in data:
            at += 1 / self._rate
            self._arrivals.append((at, byte))

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """Run the program up to `now`.

        Return the pieces that the car has sent since the last call, each with the time of its last byte.
        """
        self._run(now)
        sent = []
        while self._outgoing and self._outgoing[0][0] <= now:
            sent.append(self._outgoing.popleft())
        return sent

    def next_event(self) -> float:
        """Return the time of the next event, or inf if there is none."""
        due = self.due()
        return min(due, self._outgoing[0][0]) if self._outgoing else due

    def backlog(self, now: float) -> int:
        """Return the number of bytes still on the wire to the car. Callers feed no more bytes while it is large."""
        self._run(now)
        return len(self._arrivals)

    @property
    def now(self) -> float:
        """The time up to which the program has run."""
        return self._now

    @property
    def alive(self) -> bool:
        """False once the program has died. Only a brownout starts it again."""
        return self._alive

    @property
    def truth(self) -> Truth:
        """The state at `self.now`, the time up to which the program has run."""
        return Truth(
            mode=self._mode,
            motor_left=self._left,
            motor_right=self._right,
            blocked=self._blocked,
            fan=self._fan,
            led="off" if self._rgb == (0, 0, 0) else "#{:02x}{:02x}{:02x}".format(*self._rgb),
            servo=self._servo,
            speed=self._pwm(),
            alive=self._alive,
        )

    def pose(self, now: float) -> Pose:
        """Return the true pose of the car."""
        self._run(now)
        return self._body.pose(now)

    def press(self, button: Button, now: float) -> bool:  # noqa: ARG002 - for cars with a receiver
        """Press a button of the infrared remote; return True if the car obeys it."""
        self._run(now)
        return False

    # Faults.

    def drop_link(self, now: float) -> None:
        """Cut the link: bytes on the wire are lost. The car does not notice it, and a truncated frame stays in it."""
        self._run(now)
        self._arrivals.clear()

    def drain(self, now: float, in_s: float) -> None:
        """Let the battery run empty within a time."""
        self._body.drain(now, in_s)

    def brown_out(self, now: float) -> None:
        """Let the voltage sag. The motors stop, the frame that is being sent is truncated, and the program reboots."""
        self._run(now)
        self._cut_outgoing(now)
        self._arrivals.clear()
        self._buffer.clear()
        self._tx_free = now
        self._drive(0, 0)
        self._blocked = False
        self._mode = Mode.MANUAL
        self._fan = False
        self._rgb = (0, 0, 0)
        self._alive = True
        self._alarm_at = inf
        self._program = self._reboot()
        self._wait = Wait(now)

    def _reboot(self) -> Program:
        raise NotImplementedError

    def _cut_outgoing(self, now: float) -> None:
        sent = deque(piece for piece in self._outgoing if piece[0] <= now)
        if len(sent) < len(self._outgoing):
            end, data = self._outgoing[len(sent)]
            done = len(data) - ceil((end - now) * self._rate)
            if done > 0:
                sent.append((now, data[:done]))
        self._outgoing = sent

    # The engine.

    def due(self) -> float:
        """Return the time at which the program next runs, or inf if it never does."""
        if not self._alive:
            return inf
        until = min(self._wait.until, self._alarm_at)
        if self._wait.wakes:
            if self._buffer or self._pressed is not None:
                return self._now
            if self._arrivals:
                return min(until, self._arrivals[0][0])
        return until

    def _run(self, now: float) -> None:
        if self.scheduler is None:
            self.run_alone(now)
        else:
            self.scheduler.run(now)

    def run_alone(self, now: float) -> None:
        """Run only this program up to `now`."""
        while (due := self.due()) <= now:
            self._now = max(self._now, due)
            self._receive()
            if self._alarm_at <= self._now:
                self._on_alarm()
                continue
            try:
                self._wait = next(self._program)
            except StopIteration:
                self._alive = False
        self._now = max(self._now, now)
        self._receive()

    def _on_alarm(self) -> None:
        """Carry out the interrupt of the hardware timer, and set the next one."""
        raise NotImplementedError

    def _receive(self) -> None:
        while self._arrivals and self._arrivals[0][0] <= self._now:
            _, byte = self._arrivals.popleft()
            if len(self._buffer) < self._limit:
                self._buffer.append(byte)
            else:
                self.lost_bytes += 1

    # The building blocks of programs.

    def _pwm(self) -> int:
        return self._speed

    def _drive(self, left: int, right: int) -> None:
        if (left, right) != (self._left, self._right):
            self._left, self._right = left, right
            self._body.drive(self._now, left, right)
            self.motor_log.append((self._now, left, right))

    def _busy(self, seconds: float) -> Program:
        """Block the program. `truth` shows a block of 0.1 s or more."""
        outer = self._blocked
        self._blocked = outer or seconds >= COLOR_BLOCK_S
        yield Wait(self._now + seconds)
        self._blocked = outer

    def _turn_servo(self, degrees: int) -> Program:
        self._servo = min(180, max(0, degrees))
        yield from self._busy(SERVO_BLOCK_S)

    def _send(self, data: bytes) -> None:
        """Queue bytes on the wire to the host."""
        if not self._traits.readings:
            return
        at = max(self._now, self._tx_free)
        for start in range(0, len(data), CHUNK):
            piece = data[start : start + CHUNK]
            at += len(piece) / self._rate
            self._outgoing.append((at, piece))
        self._tx_free = at

    def _print_text(self) -> None:
        """Print the text line that some programs print after a general frame."""
        if self._traits.text:
            self._send(TEXT_LINE)

    def _frame(self, fields: str) -> bytes:
        """Return a frame with the head of this car."""
        return f"${self._traits.head},{fields}#".encode()

    def _servo_deg(self, ptz_deg: int) -> int:
        """Return the direction of the servo for the angle of a PTZ frame."""
        return ptz_deg if self._traits.ptz_direct else 180 - ptz_deg

    def _set_fan(self, digit: str) -> None:
        """Obey place 8 of a general frame."""
        if self._traits.fan_level:
            self._fan = digit == "1"
        elif digit == "1":
            self._fan = not self._fan

    def _next_interval_s(self, mean_s: float) -> float:
        """Return the time until the next report: the mean, plus or minus a random part of up to the spread."""
        spread = self._traits.spread_s
        return max(0.0, mean_s + spread * (2 * self._rng.random() - 1)) if spread else mean_s

    def _report_frame(self, cm: float | None) -> bytes:
        """Return the report of mode 0 as the Arduino and STM32 programs print it."""
        now, body, traits = self._now, self._body, self._traits
        if traits.constants:
            rest = "GS0,LF0000,HW00,GM00"
        else:
            raw = body.grayscale(now) + round(4 * (self._rng.random() - 0.5))
            gray = round(min(1023, max(0, raw)) * traits.gray_max / 1023)
            rest = f"GS{gray},LF{bits(body.line(now))},HW{bits(body.obstacle(now))},GM{bits(body.light(now))}"
        volts = body.battery_v(now) * traits.cells / 2
        more = f",{traits.more}" if traits.more else ""
        return self._frame(f"CSB{0.0 if cm is None else cm:.2f},PV{volts:.2f},{rest}{more}")

    def _arm_frame(self, joints: list[int]) -> bytes:
        return self._frame(",".join(f"J{number}{deg}" for number, deg in enumerate(joints, 1)))

    def _ranging(self) -> Generator[Wait, None, float | None]:
        """Measure once with ultrasound and return cm. Without echo, block until the timeout and return None."""
        cm = self._range()
        if cm is None:
            yield from self._busy(NO_ECHO_S)
        else:
            yield from self._busy(REPORT_BASE_S + cm * ECHO_S_PER_CM)
        return cm

    def _range(self) -> float | None:
        cm = self._body.range_cm(self._now, self._servo - 90)
        return None if cm is None else max(2.0, cm + 0.6 * (self._rng.random() - 0.5))

    def _imu_frame(self) -> bytes:
        """Return raw counts of a level MPU6050 with noise, at its default scales (131 per deg/s, 16384 per g)."""
        noise = [round(40 * (self._rng.random() - 0.5)) for _ in range(6)]
        turning = round(131 * self._body.yaw_rate_deg_s(self._now))
        values = [0, 0, turning, 0, 0, 16384]
        words = ("gx", "gy", "gz", "ax", "ay", "az")
        fields = ",".join(f"MPU{word}{value + n}" for word, value, n in zip(words, values, noise, strict=True))
        return self._frame(fields)


def bits(values: tuple[bool, ...]) -> str:
    """Return bits as the car prints them."""
    return "".join("1" if value else "0" for value in values)


MOTIONS: Final = {"1": (1, 1), "2": (-1, -1), "3": (0, 1), "4": (1, 0)}
"""Place 1 of the general frame: sign of the left and the right motor. A turn stops the inner wheels."""
SPINS: Final = {"1": (-1, 1), "2": (1, -1)}
"""Place 2, which takes precedence over place 1."""


def motion(text: str) -> tuple[int, int]:
    """Return the signs of the two motors from places 1 and 2 of a string, read by position."""
    return SPINS.get(text[3:4]) or MOTIONS.get(text[1:2], (0, 0))
