"""A controller on a workbench, on virtual time. It receives readings of an obedient car, and frames of the test."""

from collections.abc import Callable

from gateway.control.commands import Action, Answer, Command
from gateway.control.control_output import CommandRecord, LogRecord
from gateway.control.driver import TICK_S
from gateway.control.safety_state import PersistedSafety
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.frames import Frame, General, ModeClose, ModeOpen
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.timing import FRAME_S
from gateway.drivers.yahboom.stops.evidence import SETTLING_S
from schemas.rights import NO_PEOPLE, People, Sender
from schemas.words import FrameOrigin, Level, Mode, Phase, Platform, Rank, Reason
from tests.support.controls import control
from tests.support.virtual import SHORTEST_S

READING = b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#"
PI_READING = b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#"
TRACKING = b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"
RUNNING = {
    Mode.TRACKING: TRACKING,
    Mode.LIGHT_SEEKING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM11#",
    Mode.FOLLOWING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW10,GM00#",
}
REPORT_S = 1.25
RUNNING_S = 0.1
"""Intervals of reports in mode 0, and of readings in a mode that reports."""

STOP = b"$0,0,0,0,0,0,0,0,0#"
RUN = b"$1,0,0,0,0,0,0,0,0#"
BACK = b"$2,0,0,0,0,0,0,0,0#"
MODE00 = b"$4WD,MODE00#"
SHOWN_STOP = [MODE00, STOP, MODE00]
"""Frames of a stop in mode 0 until the car has shown it. Each `MODE00` makes a block gap. Two are needed, and
no frame may follow the last one."""

PERSON = Sender("mia", Rank.PERSON)
SCRIPT = Sender("script", Rank.SCRIPT)
COORDINATOR = Sender("plan", Rank.COORDINATOR)


class ObedientCar:
    """A car that obeys every frame. It sends no readings in a block, in a silent mode, or while its fan runs."""

    def __init__(self, platform: str, now: float) -> None:
        self._profile = parse_platform(platform.replace("unknown", "arduino"))
        self._pi = self._profile.kind is Platform.RASPBERRY_PI
        self._mode = Mode.MANUAL
        self.fan = False
        self.reading = PI_READING if self._pi else READING
        self.report_at = now + REPORT_S

    def wrote(self, frame: Frame, now: float) -> None:
        """Obey a frame."""
        block_s = self._profile.block_s(frame)
        if self._pi:
            return
        match frame:
            case ModeOpen(mode):
                self._mode = mode
                self.report_at = now + block_s + RUNNING_S
            case ModeClose() if self._mode is not Mode.MANUAL:
                self._mode = Mode.MANUAL
                self.report_at = now + block_s + 0.9 * REPORT_S
            case _ if block_s > FRAME_S:
                self.report_at += block_s
            case _:
                pass
        if isinstance(frame, General) and frame.fan:
            self.fan = not self.fan

    def report(self, now: float) -> bytes:
        """Return the reading that the car sends now, and schedule the next one. Empty if the car is silent."""
        running = RUNNING.get(self._mode, b"")
        self.report_at = now + (RUNNING_S if running else REPORT_S)
        if self._mode is not Mode.MANUAL:
            return running
        return b"" if self.fan else self.reading


class Workbench:
    """Drives a controller exactly as its loop does. It wakes at the controller's own deadlines, and at each event."""

    def __init__(
        self, platform: str = "arduino", *, kept: PersistedSafety | None = None, people: People = NO_PEOPLE
    ) -> None:
        self.now = 100.0
        self.control = control(
            parse_platform(platform), persisted=kept, people=people, now=self.now, now_ns=int(self.now * 1e9)
        )
        self.car = ObedientCar(platform, self.now)
        self.sent: list[tuple[float, bytes, FrameOrigin]] = []
        self.records: list[CommandRecord] = []
        self.logs: list[LogRecord] = []
        self.number = 0
        self._next_tick = self.now
        self._awake = 0

    def ready(self) -> "Workbench":
        """Connect, and wait until the car has shown that it stands. Forget all frames and records until then."""
        self.control.link_up(self.now)
        self.pump()
        self.until(lambda: self.control.driver.model.known, 12.0)
        assert self.control.driver.model.motors == "off"
        self.run(1.5 - SETTLING_S)
        self.sent.clear()
        self.take()
        self.logs.clear()
        self.records.clear()
        return self

    def hear(self, frame: bytes = b"") -> None:
        """Let the car send a frame now. The default is a mode-0 reading."""
        self.car.report_at = self.now + REPORT_S
        self._hear(frame or self.car.reading)

    def _hear(self, frame: bytes) -> None:
        for event in FrameSplitter().feed(frame, self.now):
            self.control.driver.on_event(event, self.now)
        self.pump()

    def ask(
        self,
        what: Action,
        sender: Sender = SCRIPT,
        *,
        identity: str = "",
        streamed: bool = False,
        age_s: float | None = None,
        pump: bool = True,
        take: bool = False,
    ) -> Answer:
        """Give a command."""
        self.number += 1
        command = Command(
            identity or f"c{self.number}",
            type(what).__name__,
            sender,
            what,
            age_s=age_s,
            take=take,
            asked_ns=int(self.now * 1e9),
            streamed=streamed,
        )
        answer = self.control.command(command, self.now)
        if pump:
            self.pump()
        return answer

    def run(self, seconds: float, *, reports: bool = True) -> None:
        """Let time pass. Without `reports`, all readings of the car are lost."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            wake = min(self.car.report_at, self._next_tick, self.control.driver.next_at(self.now))
            self._awake = self._awake + 1 if wake < self.now + SHORTEST_S else 0
            assert self._awake < 100, "a loop that never sleeps"
            self.now = min(end, max(self.now + 1e-9, wake))
            if self.now >= self.car.report_at:
                frame = self.car.report(self.now)
                if reports and frame:
                    self._hear(frame)
            if self.now >= self._next_tick:
                self._next_tick = self.now + TICK_S
                self.control.tick(self.now)
            self.pump()

    def until(self, so: Callable[[], bool], seconds: float = 30.0) -> None:
        """Let time pass until `so` returns True."""
        end = self.now + seconds
        while not so():
            assert self.now < end, self.sent[-6:]
            self.run(0.05)

    def pump(self) -> None:
        """Write all frames that are due."""
        while (write := self.control.driver.poll(self.now)) is not None:
            self.sent.append((self.now, write.data, write.why))
            self.control.driver.on_written(write, self.now)
            self.car.wrote(write.frame, self.now)
        self.take()

    def take(self) -> None:
        """Collect the records and the log of the controller."""
        for record in self.control.take_records():
            if isinstance(record, CommandRecord):
                self.records.append(record)
            elif record.level is not Level.DEBUG:
                self.logs.append(record)

    @property
    def frames(self) -> list[bytes]:
        """The written frames."""
        return [data for _, data, _ in self.sent]

    def records_of(self, identity: str) -> list[CommandRecord]:
        """Return the records of a command."""
        return [record for record in self.records if record.command.id == identity]

    def life(self, identity: str) -> list[Phase]:
        """Return the phases of a command."""
        return [record.phase for record in self.records_of(identity)]

    def end(self, identity: str) -> tuple[Phase, Reason | None]:
        """Return the last phase of a command, and its reason."""
        record = self.records_of(identity)[-1]
        return record.phase, record.reason
