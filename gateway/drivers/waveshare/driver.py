"""Drives one car of Waveshare's UGV family. Pure.

These cars accept JSON, one object per line, over a UART. They acknowledge nothing by themselves, but have two things
that the yahboom family lacks: a dead-man timer, and on some chassis encoders.

*One number, three meanings.* `{"T":1,"L":0.4,"R":0.4}` is 0.4 m/s on a chassis with encoders, four fifths of full power
on one without, and nearly nothing on the factory's first program. The command looks the same for all three. So no
motion is sent before the car's feedback has shown its firmware, and before the number of its chassis (`T:900`) was sent
to it. On one firmware, a reset clears that number. So after the text of a boot, or a silence in the stream of feedback,
the car may not be driven until its set-up is repeated.

*The dead-man timer.* Three seconds after the last `T:1` the motors stop. But on one firmware, `T:13` drives without
this timer, so that nothing ever stops the car, and `T:136` with a negative number turns the timer off. So we drive only
with `T:1`, set the timer to one second, and send a held motion four times in that time. The speeds in it are limited
first: beyond 2.0, the car ignores them, but the line still resets the timer. Only the commands of `ALLOWED` are ever
written.

*Evidence of a stop.* If asked to (`T:143`), the car repeats each line that it could parse. That does not prove that it
obeys. But it gives our readings an order: a feedback that arrives after the repeated stop was made after the stop. If
its wheel speeds are measured, and are zero from then on for a quarter of a second, the car stands still. Measured means
three things: the chassis has encoders, we have configured the car, and both wheels were seen to turn in a drive of ours
after that. The last is needed because an encoder with a loose wire reports zero for ever. The stop of a car that could
show it, but does not, counts as not confirmed. Any other stop ends as `sent`, which claims only that its frames were
written, and we rely on the timer.

*Lost settings.* We would not notice a setting that was lost on the link. So the chassis and the dead-man time are sent
until the car has repeated them, but at most ten times: three times if it repeats no line, and its feedback arrives at
the interval that we asked for. Then it may be driven, although it has not confirmed them.

*The first bytes.* At each boot, the car plays a mission that its owner may have stored, and any byte on the UART aborts
it. So after the link is open we listen first, and wait for the end of a boot. A stop that was commanded does not wait,
unless it joins one whose first frame is written. Our own stop after the opening of the link or a reset waits, and
another one may.

*Other programs.* The car has a web page with a known password, and accepts commands by radio. Commands of either kind
reset the dead-man timer. So if wheels turn while our last command is a stop, that is logged, and the car is stopped. No
reading of a car without encoders shows that. But an open web page sends queries, and the car prints the answers on our
link, too. So an open page is logged on every car.
"""

import json
import re
from collections import deque
from collections.abc import Mapping
from enum import Enum, auto
from typing import Any, ClassVar, Final

from gateway.control.command_records import Pending
from gateway.control.commands import Action, Drive, Find, SetLight
from gateway.control.control_output import OutgoingFrame
from gateway.control.driver import Desk, Echo, Event, Fields, Findings, TextLine
from gateway.drivers.lines import LineSplitter
from gateway.drivers.plain import UNASKED_LOG_S, PlainDriver
from gateway.drivers.plain_profile import PlainProfile
from gateway.drivers.waveshare.feedback_parser import Feedback, read_line
from gateway.drivers.waveshare.firmware import UgvFirmware
from gateway.drivers.waveshare.ugv_platforms import FULL_SPEED, PLATFORMS, Chassis
from schemas.words import FrameOrigin, Level, Light, Motion, Motors, Phase, Reason, Shows

DRIVE: Final = 1
PWM: Final = 11
POLL: Final = 130
STREAM: Final = 131
OUTPUTS: Final = 132
DEAD_MAN: Final = 136
STREAM_GAP: Final = 142
ECHO: Final = 143
CHASSIS: Final = 900
ALLOWED: Final = frozenset({DRIVE, PWM, POLL, STREAM, OUTPUTS, DEAD_MAN, STREAM_GAP, ECHO, CHASSIS})
"""The commands that a gateway sends, by their `T`. `PWM` is sent only with zero."""

DEAD_MAN_MS: Final = 1000
"""The dead-man time that a gateway sets: four times `RESEND_S`."""
STREAM_MS: Final = 200
"""Interval of the feedback. One feedback has 150 bytes, so even a bridge of 9600 baud is fast enough."""
LISTEN_S: Final = 0.5
"""Time after the opening of a link before we write. A car that resets when it is opened begins to print earlier."""
LISTEN_MAX_S: Final = 30.0
"""Maximum time for which we wait for the end of a boot. The car's two Wi-Fi timeouts take 15 s each."""
BOOT_QUIET_S: Final = 2.5
"""Silence after which a boot counts as over. Its longest pause is 2.2 s, while the car looks for its IMU."""
PROBE_S: Final = 1.0
"""Interval of our queries to a car that has not answered yet."""
SETUP_GAP_S: Final = 0.03
"""Minimum time between two frames of the set-up."""
CONFIRM_S: Final = 0.3
"""Time within which a car repeats a setting: the longest turn of its loop, and the delay of a slow link."""
SILENT_TRIES: Final = 3
BLIND_TRIES: Final = 10
"""How often the settings are sent at most. SILENT_TRIES counts for a car that repeats no line, but whose feedback comes
at the interval that we set, because that shows that our lines arrive. Otherwise BLIND_TRIES counts."""
ECHO_TRIES: Final = 3
"""Tries of a stop without an echo (a line of ours that the car repeats) after which the echo counts as switched off."""
STANDS_S: Final = 0.25
STANDS_REPORTS: Final = 3
"""Time, and number of feedbacks, for which the wheels must stand still to show a stop: two turns of the speed loop."""
TURNS_M_S: Final = 0.02
"""Minimum speed of a wheel that counts as turning: two encoder pulses per turn of the firmware's loop (some 10 ms)."""
ON_ITS_WAY_S: Final = 2.0
"""Maximum time that a line of ours takes to reach the car over a slow link."""
STUCK_S: Final = 1.0
"""Maximum time for which a wheel may stand still in a drive: twice the time that the speed loop takes to full power."""
STUCK_M: Final = 0.05
"""A wheel may stand still until it should have turned so far, if that takes longer than STUCK_S. The speed loop adds
power with this distance: from 0.012 m on the wheel turns, at 0.05 m it has 40 %. A slow wheel often reports 0."""
VOLTAGE_S: Final = 1.0
"""Interval at which an unchanged voltage is published. Feedbacks repeat the last measured voltage for up to 10 s."""
ECHO_S: Final = 2.0
"""Maximum time from a line of ours to its echo."""
INNER: Final = 0.4
"""Share of the inner wheel in a curve."""
_SIDES: Final[Mapping[Motion, tuple[float, float]]] = {
    Motion.STOP: (0.0, 0.0),
    Motion.FORWARD: (1.0, 1.0),
    Motion.BACK: (-1.0, -1.0),
    Motion.LEFT: (INNER, 1.0),
    Motion.RIGHT: (1.0, INNER),
    Motion.SPIN_LEFT: (-1.0, 1.0),
    Motion.SPIN_RIGHT: (1.0, -1.0),
}
"""Shares of the left and the right wheel."""
_BOOT: Final = re.compile(rb"rst:0x|boot:0x|entry 0x|\bets [A-Z]|LittleFS|servos status checked|Server Starts")
"""Texts of the ESP32's own boot program, and of the car's, if the first ones are lost."""
# The echo of one of our lines, which may come late, or a servo error (1005), which the car prints by itself.
_OWN: Final = re.compile(rf'\{{"T":({"|".join(map(str, {*ALLOWED, 1005}))})[,}}]'.encode())


class Setup(Enum):
    """The steps of the set-up, after which a car may be driven."""

    LISTEN = auto()
    PROBE = auto()
    CONFIGURE = auto()
    READY = auto()


def line(command: int, **fields: Any) -> bytes:
    """Return the line of a command."""
    assert command in ALLOWED
    assert command != PWM or not any(fields[side] for side in "LR")
    return json.dumps({"T": command, **fields}, separators=(",", ":")).encode() + b"\n"


class WaveshareDriver(PlainDriver):
    """One car of this family."""

    STOP_FRAMES: ClassVar[int] = 3
    STOP_GAP_S: ClassVar[float] = 0.2
    STOPS_WITHIN_S: ClassVar[float] = 0.7
    """Twice the longest turn of the firmware's loop (0.2 s: two searches for a servo), and braking from 0.5 m/s."""
    RETRY_S: ClassVar[float] = 1.0
    EVIDENCE_S: ClassVar[float] = 4.0
    RESEND_S: ClassVar[float | None] = 0.25
    SILENCE_S: ClassVar[float | None] = 1.5
    MOVES_UNASKED: ClassVar[str] = (
        "Its own web page, a radio remote or a mission may do so: close the page, and change the password of its Wi-Fi."
    )

    def __init__(self, desk: Desk, profile: PlainProfile) -> None:
        super().__init__(desk, profile)
        self._chassis = PLATFORMS[profile.name]
        self._lines = LineSplitter()
        self._sent: deque[tuple[bytes, float]] = deque(maxlen=64)
        self._number = 0
        """Number of the last frame of a stop. It is in the frame, so that its echo can be recognized."""
        self._moved_at = float("-inf")
        """When the last motion was written."""
        self._answered_at = float("-inf")
        self._forget_car(float("-inf"))

    def _forget_car(self, listen_until: float, firmware: UgvFirmware | None = None) -> None:
        """Forget everything that a reset of the car changes, and if it is not given, the firmware."""
        self._firmware = firmware
        self._setup, self._setup_at = Setup.LISTEN, listen_until
        self._listen_until = listen_until + LISTEN_MAX_S
        self._booting = False
        """True if the car prints the text of a boot."""
        self._sent.clear()
        self._unechoed = 0
        """Number of frames of stops since the last echo."""
        self._nameless = 0
        """Number of feedbacks that fit no known firmware."""
        self._rest_odometer_m: tuple[float, float] | None = None
        """The distance that the wheels had covered, m, when they were first seen to stand still."""
        self._frames: deque[bytes] = deque()
        self._unsure: list[bytes] = []
        """The settings that the car has not repeated yet."""
        self._tries = 0
        """How often the settings were sent while feedback arrived."""
        self._was_heard = self._echoes = False
        self._feedback_at = float("-inf")
        self._in_rhythm = 0
        """Number of feedbacks in a row that arrived at the interval that we set."""
        self._turned = [False, False]
        """For each wheel, True if it was seen to turn in a drive of ours since the set-up."""
        self._wanted: set[bytes] = set()
        """The last line of each try of this stop, until the car has repeated one of them."""
        self._stands_since: float | None = None
        self._stands = 0
        self._turned_at: dict[str, float] = {}
        """When each wheel was last seen to turn in this drive, or when the drive began. Empty without a drive."""
        self._odometer_m: tuple[float, float] | None = None
        self._voltage: tuple[float, float] = (0.0, float("-inf"))
        """The last published voltage, and the time of its publication."""

    # ------------------------------------------------------------------ bytes in

    def feed(self, data: bytes, now: float) -> list[Event]:
        """Return the events in the bytes."""
        if self._booting and self._setup is Setup.LISTEN and b"{" not in data:  # a booting car sends dots, not lines
            self._listen_on(now)
        return [event for each in self._lines.feed(data) for event in self._events(each, now)]

    def _listen_on(self, now: float) -> None:
        self._setup_at = min(self._listen_until, max(self._setup_at, now + BOOT_QUIET_S))

    def _events(self, text: bytes, now: float) -> list[Event]:
        if any(text == each and now <= at + ECHO_S for each, at in self._sent):
            return [Echo(text, now)]
        return read_line(text, now)

    def drop_bytes(self) -> list[Event]:
        """Forget the unfinished line."""
        rest = self._lines.take_rest()
        return [TextLine(rest, self._model.heard_at or 0.0)] if rest else []

    def sends(self, data: bytes, now: float) -> None:
        """Remember a line that the car may repeat."""
        self._sent.append((data.strip(), now))

    def measured(self, event: Event) -> Mapping[str, Fields]:
        """Return the measured values of a feedback by topic."""
        if not isinstance(event, Feedback):
            return {}
        topics: dict[str, Fields] = {}
        if self._is_measured:
            topics["sensor/wheels"] = {"left_m_s": event.left_m_s, "right_m_s": event.right_m_s}
        volts, (published_v, published_at) = event.voltage_v, self._voltage
        if volts is not None and (volts != published_v or event.at >= published_at + VOLTAGE_S):
            self._voltage = volts, event.at
            topics["sensor/battery"] = {"voltage_v": volts}
        if self._setup is not Setup.READY or self._here is None:
            return topics  # before the set-up, an angle may be that of an arm, and the chassis may be another one
        if event.odometer_m is not None:
            topics["sensor/odometer"] = dict(zip(("left_m", "right_m"), event.odometer_m, strict=True))
        if event.attitude_rad is not None:
            topics["sensor/attitude"] = dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), event.attitude_rad, strict=True))
        if event.imu_raw is not None:
            names = [f"{part}_{axis}_raw" for part in ("gyro", "accel") for axis in "xyz"]
            topics["sensor/imu"] = dict(zip(names, event.imu_raw, strict=True))
        return topics

    @property
    def _here(self) -> Chassis | None:
        """The chassis with the firmware that the car has shown. None if none is shown, or if the platform lacks it."""
        return None if self._firmware is None else self._chassis.get(self._firmware)

    @property
    def _is_measured(self) -> bool:
        """True if the wheel speeds of the feedback are measured: encoders, and a chassis that we have configured."""
        return self._setup is Setup.READY and self._here is not None and self._here.has_encoders

    # ------------------------------------------------------------------ events of the car

    def on_event(self, event: Event, now: float) -> None:
        """Update the state with an event."""
        if isinstance(event, Echo):
            self._on_echo(event)
        elif isinstance(event, TextLine):
            self._on_text(event, now)
        super().on_event(event, now)

    def _on_echo(self, event: Echo) -> None:
        self._echoes, self._unechoed = True, 0
        self._unsure = [each for each in self._unsure if each.strip() != event.raw]
        if event.raw in self._wanted and self._stands_since is None:
            self._wanted.clear()
            self._stands, self._stands_since = 0, event.at

    def _on_text(self, event: TextLine, now: float) -> None:
        if event.raw.startswith(b"{"):
            self._on_answer(event, now)
            return
        if _BOOT.search(event.raw) and self._setup is not Setup.LISTEN:
            self._on_restart("it prints the text of a boot", now)
        if self._setup is Setup.LISTEN:
            self._booting = True
            self._listen_on(now)

    def _on_answer(self, event: TextLine, now: float) -> None:
        """Log that another program talks to the car, if it soon answers a second query that was not ours."""
        if self._setup is Setup.READY and not _OWN.match(event.raw):
            again, self._answered_at = now < self._answered_at + UNASKED_LOG_S, now
            if again and self.may_log_unasked(now):
                words = f"another program talks to {self._model.name}, and can drive it: is its own web page open?"
                self._log.log(Level.WARNING, "other_program", words, now)

    def _on_restart(self, why: str, now: float) -> None:
        """Repeat the set-up before the car may be driven: its reset has undone chassis, dead-man time and stream."""
        words = f"{self._model.name} has restarted: {why}. The gateway sets it up again, and stops it first."
        self._log.log(Level.WARNING, "car_restarted", words, now)
        self._forget_car(now + BOOT_QUIET_S, self._firmware)
        self.recover(words, now)
        if now > self._moved_at + ON_ITS_WAY_S:
            self._wait_for_setup()  # else a motion of ours may still be on its way, and the stop must follow it at once

    def on_reading(self, event: Event, now: float) -> None:
        """Update firmware, wheels and voltage with a feedback."""
        if not isinstance(event, Feedback):
            return
        if event.firmware is not None and event.firmware is not self._firmware:
            self._on_firmware(event.firmware, now)
        if self._firmware is None:
            self._on_nameless(event, now)
        if self._booting and self._setup is Setup.LISTEN:  # a feedback shows that the car's loop runs: the boot is over
            self._booting, self._setup_at = False, now
        self._say_what_it_shows()
        self._was_heard = True
        gap_s, self._feedback_at = event.at - self._feedback_at, event.at
        self._in_rhythm = self._in_rhythm + 1 if 0.8 < 1000 * gap_s / STREAM_MS < 1.5 else 0
        if self._is_reset(event):
            self._on_restart("the distance of its wheels began at zero again", now)
            return
        if event.voltage_v is not None:
            self.on_voltage(event.voltage_v, now)
        if self._is_measured:
            self._on_wheels(event, now)

    def _on_nameless(self, event: Feedback, now: float) -> None:
        """Log once that a car is not driven because its feedback does not show its firmware."""
        self._nameless += 1
        if self._nameless == STANDS_REPORTS:
            words = f"{self._model.name} is not driven, as its feedback fits no known firmware: {event.raw[:120]!r}"
            self._log.log(Level.WARNING, "platform_contradicted", words, now)

    def _say_what_it_shows(self) -> None:
        car = self._model.name
        if self._model.shows is Shows.YES and not all(self._turned):
            self._model.shows = Shows.UNKNOWN
        if self._here is None or not self._here.has_encoders:
            words = f"the wheel speeds of {car} are not measured; its dead-man stops it if nothing drives it"
        elif not all(self._turned):
            words = f"{car} was not driven since its set-up, so nothing shows that its encoders work"
        elif not self._echoes:
            words = f"{car} does not repeat our lines, so nothing shows when it received the stop"
        else:
            words = f"the wheel speeds of {car} show that it stands still"
        self._model.shows_words = words

    def _is_reset(self, event: Feedback) -> bool:
        before, self._odometer_m = self._odometer_m, event.odometer_m or self._odometer_m
        return before is not None and max(map(abs, before)) > 0.5 and event.odometer_m == (0.0, 0.0)

    def _on_firmware(self, firmware: UgvFirmware, now: float) -> None:
        model, before = self._model, self._firmware
        self._firmware = firmware
        if before is not None:
            self._on_restart(f"its feedback is that of {firmware} now", now)
        name, here = model.profile.name, self._here
        evidence = (f"its feedback is that of {firmware}",)
        contradictions = () if here is not None else (f"{name} cars do not have {firmware}",)
        model.findings = Findings(evidence, contradictions)
        if here is None:
            fits = ", ".join(each for each, row in PLATFORMS.items() if firmware in row)
            words = f"{model.name} runs {firmware}, which {name} cars do not have: it is not driven. With it: {fits}."
            self._log.log(Level.WARNING, "platform_contradicted", words, now)
        model.shows = Shows.UNKNOWN if here is not None and here.has_encoders else Shows.NO
        if self._setup is Setup.PROBE:
            self._setup_at = now

    def _on_wheels(self, event: Feedback, now: float) -> None:
        """Use measured wheel speeds as evidence of a motion, of a stop, or of working encoders."""
        model = self._model
        turning = [abs(speed) >= TURNS_M_S for speed in (event.left_m_s, event.right_m_s)]
        model.turned_at = event.at if any(turning) else model.turned_at
        if model.motors is Motors.ON:
            self._turned = [seen or turns for seen, turns in zip(self._turned, turning, strict=True)]
        self._check_stuck(event, now)
        stands = event.left_m_s == 0.0 and event.right_m_s == 0.0
        if stands and self._stands_since is not None and event.at > self._stands_since:
            self._stands += 1
            if self._stands == 1:
                self._rest_odometer_m = event.odometer_m
            if event.odometer_m != self._rest_odometer_m:  # it rolls, but too slowly for a measured speed
                self._stands, self._stands_since = 0, event.at
            if self._stands >= STANDS_REPORTS and event.at >= self._stands_since + STANDS_S and all(self._turned):
                model.shows = Shows.YES
                self.show_rest(f"its wheels stood still in {self._stands} feedbacks since it repeated the stop", now)
        elif not stands and self._stands_since is not None:
            self._stands, self._stands_since = 0, event.at

    def _check_stuck(self, event: Feedback, now: float) -> None:
        """End a drive in which a wheel stands still, because the speed control adds power until the wheel turns."""
        held, standing = self.queue.held, []
        if self._model.motors is not Motors.ON or held is None or held.began_at is None:
            self._turned_at = {}
            return
        wheels = zip(("left", "right"), (event.left_m_s, event.right_m_s), self._speeds(held.motion), strict=True)
        for side, speed, wanted in wheels:
            # In a slow curve, the inner wheel shall turn no faster than a wheel that counts as turning.
            if side not in self._turned_at or abs(speed) >= min(TURNS_M_S, abs(wanted) / 2):
                self._turned_at[side] = now
            elif now >= self._turned_at[side] + max(STUCK_S, STUCK_M / max(abs(wanted), TURNS_M_S / 10)):
                standing.append(side)
        if standing:
            self._turned_at, which = {}, " and ".join(standing)
            words = f"{self._model.name} is stopped: its {which} wheel stood still. Is it blocked, or an encoder loose?"
            self._log.log(Level.WARNING, "wheel_stands", words, now)
            self.release(Phase.FAILED, Reason.STUCK, words, now)

    # ------------------------------------------------------------------ set-up

    def link_up(self, now: float) -> None:
        """Listen before anything is written, because the link is open now and the car may boot."""
        self._lines = LineSplitter()
        self._forget_car(now + LISTEN_S)
        super().link_up(now)
        self._wait_for_setup()

    def _wait_for_setup(self) -> None:
        """Let the next frame of a stop that no command asked for wait for the end of a boot."""
        if self._stop is not None and not self._stop.commands:
            self._stop.next_at = max(self._stop.next_at, self._setup_at)

    def stop(self, why: FrameOrigin, now: float, pending: Any = None) -> None:
        """Stop the car, also if it is in a mode. A stop that was commanded does not wait for the end of a boot.

        A stop that was not commanded waits if `tick` is called before its first frame is written.
        """
        super().stop(why, now, pending)
        if self._stop is not None and self._stop.index == 0:
            self._stop.next_at = now
        elif self._stop is not None and pending is not None:  # it joins a stop that may be waiting
            self._stop.next_at = min(self._stop.next_at, now + self.STOP_GAP_S)

    def tick(self, now: float) -> None:
        """Stop a car that is silent for too long, and set it up again."""
        if self._setup is Setup.LISTEN:
            self._wait_for_setup()
            return
        was_heard = self._model.is_heard
        super().tick(now)
        if was_heard and not self._model.is_heard:
            self._forget_car(now)

    def wait_words(self, now: float) -> str:
        """Describe what must happen before the car may be driven."""
        del now
        if self._setup is Setup.READY:
            return ""
        return "a feedback that shows its firmware" if self._setup is Setup.PROBE else "its set-up"

    @property
    def hears(self) -> bool:
        """Return False while the car may be booting: lines that are written then are lost or read later."""
        return self._setup is not Setup.LISTEN

    def setup_at(self) -> float:
        """Return when the next frame of the set-up is due."""
        return float("inf") if self._setup is Setup.READY else self._setup_at

    def setup_frame(self, now: float) -> bytes | None:
        """Return the next query or setting, if one is due."""
        if now < self.setup_at():
            return None
        if self._setup is Setup.LISTEN:
            self._setup = Setup.PROBE
            if self._stop is not None and self._stop.last_at < self._setup_at - SETUP_GAP_S:
                self.repeat_stop(now)  # a stop that was written during a boot may be lost
                return None
        if self._setup is Setup.PROBE:
            here = self._here
            if here is None:
                self._setup_at = now + PROBE_S
                return b"\n" + line(POLL)
            self._setup, self._tries = Setup.CONFIGURE, 0
            self._unsure = [line(CHASSIS, main=here.main, module=0), line(DEAD_MAN, cmd=DEAD_MAN_MS)]
            self._queue_settings()
        if self._frames:
            # After the last frame, leave time for its echo.
            self._setup_at = now + (SETUP_GAP_S if len(self._frames) > 1 else CONFIRM_S)
            return self._frames.popleft()
        self._tries += self._was_heard
        self._was_heard = False
        shows_it = self._in_rhythm >= STANDS_REPORTS and not self._echoes
        is_enough = self._tries >= (SILENT_TRIES if shows_it else BLIND_TRIES)
        if self._unsure and not is_enough:
            self._queue_settings()
            return None
        self._setup = Setup.READY
        self._model.heard_at = max(now, self._model.heard_at or now)  # silence counts from now, when the stream begins
        return None

    def _queue_settings(self) -> None:
        """Queue the settings that make the car repeat lines and report, and then those that it has not repeated yet."""
        self._frames.extend((line(ECHO, cmd=1), line(STREAM_GAP, cmd=STREAM_MS), line(STREAM, cmd=1)))
        self._frames.extend(self._unsure)

    # ------------------------------------------------------------------ frames out

    def refusal(self, what: Action) -> str | None:
        """Return why this car cannot do this at all, or None if it can."""
        if isinstance(what, Drive) and self._firmware is not None and self._here is None:
            name = self._model.profile.name
            return f"{self.desk.car} runs {self._firmware}, which {name} cars do not have. Correct `platform:`."
        return super().refusal(what)

    def motion_frame(self, motion: Motion) -> bytes:
        """Return the line of a motion. No number in it exceeds FULL_SPEED."""
        left, right = self._speeds(motion)
        return line(DRIVE, L=left, R=right)

    def _speeds(self, motion: Motion) -> tuple[float, float]:
        """Return the commanded speeds of the left and the right wheels."""
        speed = min(FULL_SPEED, max(0.0, FULL_SPEED * self._model.speed))
        left, right = (round(speed * share, 3) for share in _SIDES[motion])
        return left, right

    def on_written(self, write: OutgoingFrame, now: float) -> None:
        """Update the state, and note when a motion was last sent."""
        super().on_written(write, now)
        if self._model.motors is Motors.ON:
            self._moved_at = now

    def _begin(self, why: FrameOrigin, now: float, commands: list[Pending], *, is_soft: bool) -> None:
        """Begin a stop. Forget earlier readings of the wheels, which are no evidence of this stop."""
        self._wanted.clear()
        self._stands_since, self._stands = None, 0
        super()._begin(why, now, commands, is_soft=is_soft)

    def stop_frame(self, index: int) -> bytes:
        """Return a line of a stop: two set the power to zero, the last one the speed. A number marks each line's echo.

        The speed loop has an integral, which it keeps while power is set directly, and drops when the wheels stand
        still. If the speed were set at once, the loop would continue with the old integral. So the speed is set last.
        """
        self._number += 1
        if index == self.STOP_FRAMES - 1:
            return line(DRIVE, L=0, R=0, n=self._number)
        # The line end before the first one ends a line that a lost link may have truncated.
        return (b"\n" if index == 0 else b"") + line(PWM, L=0, R=0, n=self._number)

    def on_stop_written(self, data: bytes, now: float) -> None:
        """Expect the echo of the last line of a stop."""
        del now
        self._unechoed += 1
        if self._stop is not None and self._stop.index >= self.STOP_FRAMES:
            self._wanted.add(data.strip())

    @property
    def can_show(self) -> bool:
        """Return True if wheel speeds of zero would show a stop now."""
        is_heard = self._echoes and self._unechoed < ECHO_TRIES * self.STOP_FRAMES
        return self._is_measured and all(self._turned) and is_heard

    def part_frames(self, what: Action) -> tuple[bytes, ...] | None:
        """Return the lines that switch the lights, which are at the two switched outputs."""
        match what:
            case SetLight(Light.WHITE | Light.OFF as light):
                states = [light is Light.WHITE]
            case Find():
                states = [True, False] * 3
            case _:
                return None
        return tuple(line(OUTPUTS, IO4=255 * is_on, IO5=255 * is_on) for is_on in states)

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail all commands, because the link is down, and forget the car's state."""
        super().link_down(reason, now, cause=cause)
        self._forget_car(now)
