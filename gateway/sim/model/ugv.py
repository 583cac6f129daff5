"""A car of Waveshare's UGV family: its two firmwares, with their hazards. Pure.

docs/reference/waveshare.md describes what the programs do. Nobody has measured these cars. Four things that the source
does not say are guesses here: the time of one turn of the program's loop, how fast the motors follow, the pauses of a
boot, and the size of the UART's buffer, which is the default of the ESP32's Arduino core.

The program is one loop: it obeys the lines that have arrived, controls the speed, reports, and checks its dead-man
timer, which stops the motors after some time without a command. While a delay or a mission blocks the loop, the timer
is not checked either.
"""

import json
import re
from collections import deque
from collections.abc import Mapping
from math import degrees, inf, isfinite, pi
from typing import Any, Final, NoReturn

from msgspec import Struct

from gateway.sim.model.car_body import TOP_SPEED_M_S, CarBody
from gateway.sim.model.firmware_base import Pose, Rng, Truth
from gateway.sim.model.ir_remote import SIGNS, Button
from gateway.sim.model.scheduler import EventScheduler
from schemas.words import Mode

UGV_BYTES_PER_S: Final = 11520.0
LOOP_S: Final = 0.01
SPEED_LOOP_S: Final = 0.1
FOLLOW: Final = 0.35
"""Fraction of the difference to the new speed by which the motors change in one turn of the loop.

A car at full speed is almost still after some 0.1 s.
"""
UGV_DEAD_MAN_S: Final = 3.0
UGV_LIMIT_M_S: Final = 2.0
"""A car with a closed speed loop ignores speeds above this. The command still restarts the dead-man timer."""
MAX_DOCUMENT: Final = 256
UGV_RX_BUFFER: Final = 256
"""Maximum bytes that wait in the UART while the loop is blocked. Further bytes are lost."""
UGV_PIECE: Final = 16
"""Number of bytes that arrive at one time in the model, much fewer than the buffer holds."""
UGV_LINE_LIMIT: Final = 65536
"""Maximum length of a line without an end. The program has no limit but its memory."""
BATTERY_S: Final = 10.0
PAGE_S: Final = 1.5
"""Interval at which the car's own web page repeats the command of the last button."""
PAGE_ASKS_S: Final = ((1.0, 130), (2.5, 405))
"""Intervals of the page's queries (number `T`) while it is open. The answers are sent to the UART, too."""
WIFI_S: Final = 15.0
"""Time for which `T:403`, `T:404` and `T:407` look for a network. Nothing else runs, not even the dead-man timer."""
SERVO_SEARCH_S: Final = 0.1
"""Time for which the car waits for a servo that does not answer."""
PAGE_OPEN_S: Final = 10.0
"""Minimum time for which the page stays open after a press. It is open for as long as it repeats a command."""
KP: Final = 20.0
KI: Final = 2000.0
"""Gains of the speed loop after a reset. `T:2` sets them."""
DEAD_DUTY: Final = 23.0
"""A smaller duty counts as zero. The duty is the power of a motor, -255..255."""
_ROM: Final = b"ets Jul 29 2019 12:21:46\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nentry 0x400805e4\r\n"
_SETUP: Final = (
    (0.3, b"INA219 initialized.\r\n"),
    (0.6, b"LittleFS mounted.\r\n"),
    (1.2, b"All bus servos status checked.\r\n"),
    (1.3, b"AP SSID: UGV\r\n......"),
    (1.9, b"\r\nServer Starts.\r\n"),
)
"""The texts of a boot, each with its time since the start of the boot."""
UGV_BOOT_S: Final = 2.0
"""Time from a reset until the loop runs."""
_PARTS: Final = re.compile(r'"(\w+)"\s*:\s*(-?\d+(?:\.\d+)?)')
"""One field of a command to the web interface, which also accepts a truncated command."""
_DUMP: Final = """\
---=== File Content ===---
reading file: [boot] starts:

{"name":"boot","intro":"these cmds run automatically at boot."}
%s^^^ ^^^ ^^^ reading file: boot.mission ends. ^^^ ^^^ ^^^
"""
"""The text of the boot mission, which the program prints with a line for each step."""
UART_S: Final = 0.3
"""Time from a reset until the program has opened its UART. Bytes that arrive before that are lost."""

_M_PER_PULSE: Final[Mapping[bool, Mapping[int, float]]] = {
    False: {1: 0.0800 * pi / 2100, 2: 0.0800 * pi / 1650, 3: 0.0523 * pi / 1092},
    True: {1: 0.0800 * pi / 2100, 2: 0.0800 * pi / 660, 3: 0.0523 * pi / 1092},
}
"""Distance of one pulse of an encoder by the number of the chassis, for both firmwares (True: ROS)."""
_TRACK_M: Final[Mapping[int, float]] = {1: 0.125, 2: 0.172, 3: 0.141}
"""Distance of the wheels with which the program computes `T:13`."""


class UgvBuild(Struct, frozen=True):
    """One product: its firmware, and its real chassis. `main` is the number of the chassis in `T:900`."""

    is_ros: bool
    main: int
    has_encoders: bool


UGV_BUILDS: Final[Mapping[str, UgvBuild]] = {
    "wave_rover": UgvBuild(is_ros=False, main=1, has_encoders=False),
    "ugv01": UgvBuild(is_ros=False, main=3, has_encoders=True),
    "ugv02": UgvBuild(is_ros=False, main=2, has_encoders=False),
    "ugv_rover": UgvBuild(is_ros=True, main=2, has_encoders=True),
    "ugv_beast": UgvBuild(is_ros=True, main=3, has_encoders=True),
}


class UgvCar:
    """One car and its UART on virtual time. Times are seconds from any origin and must not run backwards.

    The options are:

    - `mission`: after each reset, the boot mission drives for 2 s. A closed speed loop does not run meanwhile, so a car
      that has one after a reset (the ROS firmware) stands, and obeys nothing.
    - `no_encoder`: the left encoder counts nothing, as with a loose wire.
    - `quiet`: `T:605` is 0, so the car does not repeat the lines that it gets.
    - `arm`: the boot mission says that there is an arm. Its position then overwrites fields of the same name in the
      feedback: the yaw `y`, or with ROS the accelerations `ax`, `ay`, `az`.
    - `gimbal`: the boot mission says that there is a gimbal, but there is none. So each turn of the loop waits for two
      servos.
    """

    def __init__(
        self, build: UgvBuild, body: CarBody, rng: Rng, *, options: frozenset[str] = frozenset(), now: float = 0.0
    ) -> None:
        self._build = build
        self._body = body
        self._rng = rng
        self._options = options
        self._now = now
        self._arrivals: deque[tuple[float, bytes]] = deque()
        self._uart = bytearray()
        """The bytes that have arrived and that the program has not read yet."""
        self.lost_bytes = 0
        """Number of bytes dropped because the UART's buffer was full."""
        self._rx_free_at = now
        self._out: deque[tuple[float, bytes]] = deque()
        self._tx_free_at = now
        module = 1 if "arm" in options else 2 if "gimbal" in options else 0
        self._kept = (self._default_main, module) if module else None
        """Chassis and module (1 is an arm, 2 a gimbal, 0 none) of the `T:900` in the boot mission, or None if there is
        none. The ROS firmware stores each `T:900` there."""
        self._pulses = [0.0, 0.0]
        """The true count of each encoder since the reset."""
        self._wheels = [0.0, 0.0]
        """The true speed of each wheel, m/s."""
        self._page: tuple[int, int] | None = None
        """The motion that the web page repeats, as the sign of each side. None if it repeats none."""
        self.scheduler: EventScheduler | None = None
        self.alive: Final = True
        self.runaway_since: float | None = None
        """When the motors began to run on a command without an armed dead-man timer. None if they do not."""
        self.wrong_since: float | None = None
        """When a line of the host began to move the car with a wrong chassis set. None if none does."""
        self._reset(now, text=False)
        self._boot_until = self._uart_from = now  # the program has already run for a while
        self._mission: list[tuple[float, str]] = []
        if self._kept is not None:
            self._set_chassis(*self._kept)

    # ------------------------------------------------------------------ the calls of the simulation

    @property
    def truth(self) -> Truth:
        """The true state. The numbers of the motors are their duties, -255..255."""
        left, right = (round(each) for each in self._duty)
        light = "#ffffff" if self._outputs[0] else "off"
        speed = round(max(map(abs, self._duty if self._raw else (255 * each for each in self._target))))
        return Truth(
            Mode.MANUAL,
            left,
            right,
            blocked=self._blocked_until > self._now,
            fan=False,
            led=light,
            servo=90,
            speed=speed,
            alive=True,
        )

    @property
    def moving(self) -> bool:
        """True if a wheel turns."""
        return any(abs(each) > 0.005 for each in self._wheels)

    def pose(self, now: float) -> Pose:
        """Return the true pose."""
        return self._body.pose(now)

    def feed(self, data: bytes, now: float) -> None:
        """Put bytes on the link; they reach the car at the rate of its UART."""
        self._run(now)
        self._rx_free_at = max(now, self._rx_free_at)
        for start in range(0, len(data), UGV_PIECE):
            piece = data[start : start + UGV_PIECE]
            self._rx_free_at += len(piece) / UGV_BYTES_PER_S
            if self._rx_free_at >= self._uart_from:
                self._arrivals.append((self._rx_free_at, piece))

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """Run up to `now`; return the pieces sent since the last call."""
        self._run(now)
        sent = []
        while self._out and self._out[0][0] <= now:
            sent.append(self._out.popleft())
        return sent

    def next_event(self) -> float:
        """Return the time of the next event."""
        return min(self._next_turn, self._out[0][0] if self._out else inf)

    def backlog(self, now: float) -> int:
        """Return the number of bytes still on the wire."""
        return sum(len(data) for at, data in self._arrivals if at > now)

    def drop_link(self, now: float) -> None:
        """Cut the link: the bytes on the way are lost. A partial line stays, and the next bytes are joined to it."""
        self._run(now)
        self._arrivals.clear()
        self._out.clear()

    def drain(self, now: float, in_s: float) -> None:
        """Let the battery run empty within a time."""
        self._body.drain(now, in_s)

    def brown_out(self, now: float) -> None:
        """Reset the car."""
        self._run(now)
        self._reset(now, text=True)

    def switch_off(self, now: float) -> None:
        """Switch the car off until the next `brown_out`. It rolls to a stop, and does and sends nothing."""
        self._run(now)
        self._reset(now, text=False)
        self._boot_until, self._mission, self._uart_from = inf, [], inf

    def press(self, button: Button, now: float) -> bool:
        """Press a button of the car's own web page; return True if the page has that button.

        The page repeats the command until the next button or a reset, and is open for that time.
        """
        self._run(now)
        if button not in SIGNS:
            return False
        self._page = None
        if button is not Button.STOP:
            self._page = SIGNS[button]
        self._page_at = now
        self._page_open = now, now + PAGE_OPEN_S
        if button is Button.STOP:
            self._obey({"T": 1, "L": 0, "R": 0})
        return True

    def take_http(self, text: str, now: float) -> None:
        """Obey a command to the web interface: all fields that can be parsed, even if the text ends too early."""
        self._run(now)
        self._obey({name: float(value) for name, value in _PARTS.findall(text)})

    def due(self) -> float:
        """Return the time at which the program next runs."""
        return self._next_turn

    def run_alone(self, now: float) -> None:
        """Run this program up to `now`."""
        while self._next_turn <= now:
            self._now = self._next_turn
            self._next_turn += LOOP_S
            self._turn()
        self._now = max(self._now, now)

    def _run(self, now: float) -> None:
        if self.scheduler is None:
            self.run_alone(now)
        else:
            self.scheduler.run(now)

    # ------------------------------------------------------------------ a reset

    def _reset(self, now: float, *, text: bool) -> None:
        """Forget everything that is in RAM, as a reset does."""
        ros = self._build.is_ros
        self._raw = not ros
        """True while the speed loop is off: after `T:11`, and for each motion of a car without a speed loop."""
        self._geometry = self._default_main
        """The last known chassis of a `T:900`. It sets the direction of the motors and the size of the wheels."""
        self._set_chassis(self._default_main, 0)
        self._plays = False
        """True while the car plays an endless mission. A byte from the host ends the mission."""
        self._target = [0.0, 0.0]
        """The speeds that the speed loop controls."""
        self._inputs = [0.0, 0.0]
        """The last speeds of a command, before `T:138` scales them."""
        self._integral = [0.0, 0.0]
        self._gains = KP, KI
        self._duty = [0.0, 0.0]
        self._power = [0.0, 0.0]
        """The duty at the pins of the motors, in their true direction."""
        self._speeds = [0.0, 0.0]
        """The speeds that the encoders measured in the last turn of the loop."""
        self._commanded: tuple[int, int] | None = None
        """The duty that a car without a speed loop reports as speeds until the encoders are read again."""
        self._outputs = (0, 0)
        self._dead_man_s = UGV_DEAD_MAN_S
        self._fed_at = now
        self._timed_out = False
        self._unguarded = False
        """True while the dead-man timer does not stop a drive: in the ROS firmware, a `T:13` after a timeout drives,
        but does not restart the timer."""
        self._stream = ros
        self._gap_s = 0.05 if ros else 0.0
        self._echo = not ros
        self._talks = "quiet" not in self._options
        self._rate = [1.0, 1.0]
        self._reported_at = -inf
        self._line = bytearray()
        self._blocked_until = -inf
        self._page = None
        self._page_at = inf
        self._page_open = (-inf, -inf)
        """The times at which the page was opened and is closed."""
        self._volts: tuple[float, float] = (self._body.battery_v(now) * 1.5, now)
        self._speed_at = now
        self._pulses = [0.0, 0.0]
        self._counted = [0, 0]
        self._counted_at = now
        self._next_turn = now + LOOP_S
        self._boot_until = now + UGV_BOOT_S
        self._cut_outgoing(now)
        self._arrivals.clear()
        self._uart.clear()
        self._uart_from = now + UART_S
        self._mission = self._boot_mission(now + UGV_BOOT_S)
        if text:
            self._print(_ROM)
            for at, words in _SETUP:
                self._out.append((now + at, words))
            self._tx_free_at = now + _SETUP[-1][0]
            self._print_mission()

    def _cut_outgoing(self, now: float) -> None:
        """Lose what is not sent yet. The piece that is being sent ends in the middle."""
        while self._out and self._out[-1][0] > now:
            at, data = self._out.pop()
            sent = int(len(data) - (at - now) * UGV_BYTES_PER_S)
            if sent > 0:
                self._out.append((now, data[:sent]))
                break
        self._tx_free_at = now

    def _boot_mission(self, at: float) -> list[tuple[float, str]]:
        """Return the steps of the boot mission with their times."""
        steps = []
        if self._kept is not None:
            main, module = self._kept
            steps.append((at, f'{{"T":900,"main":{main},"module":{module}}}'))
        if "mission" in self._options:
            steps += [(at, '{"T":1,"L":0.3,"R":0.3}'), (at + 2.0, '{"T":1,"L":0,"R":0}')]
        return steps

    def _print_mission(self) -> None:
        """Print the boot mission, as the program does at each boot, and the ROS firmware at each `T:900`."""
        steps = [f"[StepNum: {number} ] - {step}\n" for number, (_, step) in enumerate(self._boot_mission(0.0), 1)]
        self._print((_DUMP % "".join(steps)).replace("\n", "\r\n").encode())

    @property
    def _default_main(self) -> int:
        """The chassis that is compiled into the firmware."""
        return 2 if self._build.is_ros else 1

    def _set_chassis(self, main: int, module: int) -> None:
        """Set chassis and module, as `T:900` does. It does not stop the motors."""
        self._main, self._module = main, module
        if main in _TRACK_M:
            self._geometry = main
            if not self._build.is_ros:
                self._raw = main != 3

    # ------------------------------------------------------------------ one turn of the loop

    def _turn(self) -> None:
        now = self._now
        self._receive(now)
        if now >= self._boot_until:
            self._run_mission(now)
            if self._plays and self._uart:
                self._plays = False
            if now >= self._blocked_until and not self._mission and not self._plays:
                self._take_lines(now)
            if now >= max(self._blocked_until, self._boot_until) and not self._mission and not self._plays:
                self._run_page(now)
                self._count_pulses(now)
                self._control(now)
                self._report(now)
                self._check_dead_man(now)
                self._search_servos(now)
        self._move(now)

    def _run_mission(self, now: float) -> None:
        """Play the boot mission, each step at its time. A byte on the UART ends it when the next step is due.

        With an open loop, a step sets the duty at once.
        """
        while self._mission and now >= self._mission[0][0]:
            if self._uart:
                self._mission.clear()
                self._say("[missionPlay abort.]")
                return
            self._obey(json.loads(self._mission.pop(0)[1]))
            if not self._mission:
                self._say("[missionPlay finished.]")

    def _search_servos(self, now: float) -> None:
        """Wait for the two servos of a gimbal that is not there."""
        if self._module == 2:
            self._blocked_until = now + 2 * SERVO_SEARCH_S
            for number in (1, 2):
                self._print(b'{"T":1005,"id":%d,"status":0}\r\n' % number)

    def _run_page(self, now: float) -> None:
        """Repeat the command of the pressed button, and send the queries of the open page."""
        if self._page is not None and now >= self._page_at:
            self._page_at = now + PAGE_S
            self._obey({"T": 1, "L": 0.3 * self._page[0], "R": 0.3 * self._page[1]})
        since, until = self._page_open
        for interval_s, question in PAGE_ASKS_S if now < until or self._page is not None else ():
            if (now - since) % interval_s < LOOP_S:
                self._obey({"T": question})

    @property
    def _is_closed(self) -> bool:
        """True if this firmware has a closed speed loop for the chassis that it is set to."""
        return self._build.is_ros or self._main == 3

    def _control(self, now: float) -> None:
        """Compute the duty of the motors: every 100 ms with a closed loop, and at once with an open one."""
        if self._raw:
            return
        is_due = now >= self._speed_at + SPEED_LOOP_S
        if is_due:
            self._speed_at = now
        for side in (0, 1):
            if is_due:
                self._compute(side)
            if self._inputs[side] == 0.0 and self._speeds[side] == 0.0:
                self._duty[side] = 0.0
        self._set_pins()

    def _compute(self, side: int) -> None:
        """Compute the duty of one side from its error."""
        error = self._target[side] - self._speeds[side]
        of_error, of_integral = self._gains
        if self._inputs[side] == 0.0 and self._speeds[side] == 0.0:
            self._integral[side] = 0.0
        self._integral[side] = _clip(self._integral[side] + of_integral * SPEED_LOOP_S * error, 255.0)
        duty = _clip(of_error * error + self._integral[side], 255.0)
        self._duty[side] = duty if abs(duty) >= DEAD_DUTY else 0.0

    def _set_pins(self) -> None:
        """Write the duty to the motors. Only here does the direction of a chassis take effect."""
        self._power = [self._sign * each for each in self._duty]

    def _set_duty(self, left: float, right: float) -> None:
        """Set the duty of the motors at once, and turn the speed loop off."""
        self._raw = True
        self._duty = [_clip(left, 255.0), _clip(right, 255.0)]
        self._set_pins()
        if not self._is_closed:
            self._commanded = round(self._duty[0]), round(self._duty[1])

    def _count_pulses(self, now: float) -> None:
        """Measure the speeds: the pulses since the last turn of the loop, by the wheels of the chassis that is set.

        A slow wheel has less than one pulse in a turn, so its speed is often 0.
        """
        self._commanded = None
        for side in (0, 1):
            count = int(self._pulses[side])
            per_pulse = self._sign * _M_PER_PULSE[self._build.is_ros][self._geometry]
            passed_s = max(now - self._counted_at, LOOP_S / 2)
            self._speeds[side] = round(per_pulse * (count - self._counted[side]) / passed_s, 4)
            self._counted[side] = count
        self._counted_at = now

    def _has_signal(self, side: int) -> bool:
        """Return True if the encoder of this side counts."""
        return self._build.has_encoders and not ("no_encoder" in self._options and side == 0)

    @property
    def _sign(self) -> int:
        """Return -1 if the motors turn the wrong way, because the program is set to a wrong chassis; otherwise 1."""
        inverted = (3,) if self._build.is_ros else (2, 3)
        return 1 if (self._geometry in inverted) is (self._build.main in inverted) else -1

    def _check_dead_man(self, now: float) -> None:
        """Stop once if nothing has restarted the dead-man timer in time. The car sends no message.

        The stop does not last: the next command drives the car again.
        """
        if not self._timed_out and 0.0 <= self._dead_man_s < now - self._fed_at:
            self._timed_out, self._unguarded = True, False
            self._set_target(0.0, 0.0)

    def _feed_dead_man(self) -> None:
        self._fed_at, self._timed_out, self._unguarded = self._now, False, False

    def _move(self, now: float) -> None:
        """Change the speed of the wheels towards the duty of the motors, and move the car by its wheels."""
        for side in (0, 1):
            wanted = TOP_SPEED_M_S * self._power[side] / 255
            self._wheels[side] += FOLLOW * (wanted - self._wheels[side])
            if abs(self._wheels[side] - wanted) < 0.002:
                self._wheels[side] = wanted
            if self._has_signal(side):
                per_pulse = _M_PER_PULSE[self._build.is_ros][self._build.main]
                self._pulses[side] += self._wheels[side] * LOOP_S / per_pulse
        pwm = [round(255 * each / TOP_SPEED_M_S) for each in self._wheels]
        self._body.drive(now, pwm[0], pwm[1])
        armed = self._dead_man_s >= 0.0 and not self._timed_out and not self._unguarded
        drives = any(self._duty if self._raw else self._target)
        self.runaway_since = (self.runaway_since or now) if drives and not armed else None

    # ------------------------------------------------------------------ from the host

    def _receive(self, now: float) -> None:
        """Move the bytes that have arrived into the buffer of the UART. Bytes that do not fit are lost."""
        while self._arrivals and self._arrivals[0][0] <= now:
            piece = self._arrivals.popleft()[1]
            fits = piece[: UGV_RX_BUFFER - len(self._uart)]
            self._uart += fits
            self.lost_bytes += len(piece) - len(fits)

    def _take_lines(self, now: float) -> None:
        """Obey the whole lines in the buffer. A partial line stays, and the next bytes are joined to it.

        A command that blocks the loop leaves the lines behind it in the buffer.
        """
        while self._uart and now >= max(self._blocked_until, self._boot_until) and not self._plays:
            end = self._uart.find(b"\n") + 1
            part = self._uart[: end or len(self._uart)]
            del self._uart[: len(part)]
            self._line += part[: UGV_LINE_LIMIT - len(self._line)]
            if end:
                text = bytes(self._line).strip(b"\r\n").decode("latin-1")
                self._line.clear()
                self._on_line(text)

    def _on_line(self, text: str) -> None:
        """Obey the first object of a line. A wrong line is ignored without a message."""
        if not text.strip() or len(text) > MAX_DOCUMENT:
            return
        try:
            found, _ = _DECODER.raw_decode(text.strip())
        except (ValueError, RecursionError):
            return
        if self._echo and self._talks:
            self._print(f"{text}\r\n".encode("latin-1"))
        command = found if isinstance(found, dict) else {}
        if _whole(command, "T") in (1, 11, 13):
            moves = any(_number(command, name) for name in "LRXZ") and self._main != self._build.main
            self.wrong_since = (self.wrong_since or self._now) if moves else None
        self._obey(command)

    def _obey(self, command: Mapping[str, Any]) -> None:
        left, right, number = _number(command, "L"), _number(command, "R"), _whole(command, "cmd")
        match _whole(command, "T"):
            case 0 if self._build.is_ros:
                self._set_target(0.0, 0.0)
            case 1 if _is_number(command, "L") and _is_number(command, "R"):
                self._feed_dead_man()
                self._set_target(left, right)
            case 2:
                of_error, of_integral = _number(command, "P"), _number(command, "I")
                if min(of_error, of_integral) >= 0.0:
                    self._gains = of_error, of_integral
            case 11:
                self._feed_dead_man()
                self._set_duty(left, right)
            case 13:
                turn = _number(command, "Z") * _TRACK_M[self._geometry] / 2
                if self._build.is_ros:  # this command does not restart the dead-man timer
                    self._unguarded = self._timed_out
                else:
                    self._feed_dead_man()
                self._set_target(_number(command, "X") - turn, _number(command, "X") + turn)
            case 111:
                self._blocked_until = self._now + max(0, number) / 1000
            case 115 if self._raw:  # otherwise the speed loop sets the pins again in the next turn
                self._duty, self._power = [0.0, 0.0], [0.0, 0.0]
            case 242:
                self._plays = True
            case 403 | 404 | 407:
                self._blocked_until = self._now + WIFI_S
            case 130:
                self._report(self._now, asked=True)
            case 131:
                self._stream = number != 0
            case 132:
                self._outputs = min(255, max(0, _whole(command, "IO4"))), min(255, max(0, _whole(command, "IO5")))
            case 136:
                self._dead_man_s = number / 1000
            case 138:
                self._rate = [min(1.0, abs(left)), min(1.0, abs(right))]
            case 142:
                self._gap_s = abs(number) / 1000
            case 143:
                self._echo = number != 0
            case 405:
                self._print(b'{"T":405,"ssid":"UGV"}')  # without a line end
            case 600:
                self._reset(self._now, text=True)
            case 605:
                self._talks = number != 0
            case 4:
                self._module = number
            case 900:
                self._set_chassis(_whole(command, "main"), _whole(command, "module"))
                if self._build.is_ros:
                    self._keep_chassis()
            case _:
                pass

    def _keep_chassis(self) -> None:
        """Store the chassis in the boot mission. The program prints the mission before."""
        self._print_mission()
        kept = self._main, self._module
        words = "same mm_json already saved." if kept == self._kept else "new mm_json replaced."
        self._print(f"{words if self._kept is not None else 'new mm_json appended.'}\r\n".encode())
        self._kept = kept

    def _set_target(self, left: float, right: float) -> None:
        """Set the speeds of a closed loop, or the duty of an open one. A closed loop ignores too high speeds.

        It turns the loop on before it looks at the speeds. It compares the new speed, scaled by `T:138`, with the last
        one before its scaling, and sets only another one. So with a scale of a half, it ignores a doubled speed.
        """
        if not self._is_closed:
            self._set_duty(512.0 * left * self._rate[0], 512.0 * right * self._rate[1])
            return
        self._raw = False
        if not max(abs(left), abs(right)) <= UGV_LIMIT_M_S:
            return
        for side, speed in enumerate((left, right)):
            scaled = speed * self._rate[side]
            if scaled != self._inputs[side]:
                self._target[side], self._inputs[side] = scaled, speed

    # ------------------------------------------------------------------ to the host

    def _report(self, now: float, *, asked: bool = False) -> None:
        """Send a feedback, unless the last one was sent less than `_gap_s` (`T:142`) ago. This also limits answers."""
        if not (asked or self._stream) or now < self._reported_at + max(self._gap_s, LOOP_S):
            return
        self._reported_at = now
        if now >= self._volts[1] + BATTERY_S:
            self._volts = self._body.battery_v(now) * 1.5, now
        volts = self._volts[0]
        wheels: dict[str, float] = dict(zip("LR", self._commanded or self._speeds, strict=True))
        if self._build.is_ros:
            gyro = round(16.4 * self._body.yaw_rate_deg_s(now))
            imu = {"ax": 0, "ay": 0, "az": 8192, "gx": 0, "gy": 0, "gz": gyro, "mx": 1, "my": 2, "mz": 3}
            cm_per_pulse = 100 * self._sign * _M_PER_PULSE[True][self._geometry]
            way = {"odl": int(cm_per_pulse * self._pulses[0]), "odr": int(cm_per_pulse * self._pulses[1])}
            fields: dict[str, float] = {"T": 1001, **wheels, **imu, **way, "v": int(100 * volts)}
        else:
            yaw = round(degrees(self._body.pose(now).heading_rad), 2)
            fields = {"T": 1001, **wheels, "r": 0.4, "p": -0.2, "y": yaw, "temp": 41.5, "v": round(volts, 2)}
        if self._module == 1:
            # With an arm, a real car sends these names twice, the second time with the position of the arm. The last
            # value counts.
            places = [f"a{each}" for each in "xyz"] if self._build.is_ros else list("xyz")
            fields |= dict(zip(places, (310.2, -194.1, 228.6), strict=True)) | {"torB": -56, "torS": 12}
        elif self._module == 2:
            fields |= {"pan": 0, "tilt": 0}
        self._print(json.dumps(fields, separators=(",", ":")).encode() + b"\r\n")

    def _say(self, words: str) -> None:
        """Print a text that `T:605` turns off."""
        if self._talks:
            self._print(f"{words}\r\n".encode())

    def _print(self, data: bytes) -> None:
        self._tx_free_at = max(self._now, self._tx_free_at) + len(data) / UGV_BYTES_PER_S
        self._out.append((self._tx_free_at, data))


def _refuse(word: str) -> NoReturn:
    """Refuse `NaN` and `Infinity`, which are no JSON."""
    raise ValueError(word)


_DECODER: Final = json.JSONDecoder(parse_constant=_refuse)


def _is_number(command: Mapping[str, Any], name: str) -> bool:
    value = command.get(name)
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(command: Mapping[str, Any], name: str) -> float:
    """Return a field, which may be infinite. A field that is missing, or that is not a number, counts as 0."""
    return float(command[name]) if _is_number(command, name) else 0.0


def _whole(command: Mapping[str, Any], name: str) -> int:
    """Return a field as a whole number. A text may have a number, and what is none, or does not fit, counts as 0."""
    try:
        number = float(command.get(name, 0))
    except (TypeError, ValueError):
        return 0
    return int(number) if isfinite(number) and abs(number) < 2**31 else 0


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
