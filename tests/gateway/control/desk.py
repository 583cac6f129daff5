"""A controller without a car, on virtual time: the test says what is heard, and sees what would be written."""

from collections.abc import Callable

from gateway.control.controller import Controller
from gateway.control.records import (
    Answer,
    Command,
    CommandRecord,
    Kind,
    Level,
    LogRecord,
    Phase,
    Reason,
    Sender,
    What,
    Why,
)
from gateway.control.safety import Kept
from gateway.protocol.decode import Decoder
from gateway.protocol.profile import parse_platform

READING = b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#"
PI_READING = b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#"
TRACKING = b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"

STOP = b"$0,0,0,0,0,0,0,0,0#"
RUN = b"$1,0,0,0,0,0,0,0,0#"
BACK = b"$2,0,0,0,0,0,0,0,0#"
MODE00 = b"$4WD,MODE00#"

PERSON = Sender("mia", Kind.PERSON)
SCRIPT = Sender("script", Kind.SCRIPT)
COORDINATOR = Sender("plan", Kind.COORDINATOR)


class Desk:
    """Drives a controller exactly as its loop does: it is woken by what it says, and by what happens."""

    def __init__(self, platform: str = "arduino", *, kept: Kept | None = None) -> None:
        self.now = 100.0
        self.control = Controller("red", parse_platform(platform), kept=kept)
        self.reading = PI_READING if platform.startswith("raspberry_pi") else READING
        self.sent: list[tuple[float, bytes, Why]] = []
        self.records: list[CommandRecord] = []
        self.logs: list[LogRecord] = []
        self.number = 0

    def ready(self) -> "Desk":
        """Connect, recover, and forget what was written until then."""
        self.control.link_up(self.now)
        self.pump()
        self.run(5.0, reports=False)
        self.hear()
        assert self.control.known
        self.run(1.0)
        self.sent.clear()
        self.take()
        self.logs.clear()
        return self

    def hear(self, frame: bytes = b"") -> None:
        """The car sends a frame; if none is given, a mode-0 reading."""
        for event in Decoder().feed(frame or self.reading, self.now):
            self.control.heard(event, self.now)
        self.pump()

    def ask(
        self,
        what: What,
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
        """Let time pass; with reports a mode-0 reading comes every second, but for the one while `MODE00` blocks."""
        end = self.now + seconds
        report_at = self.now + 1.0 if reports else float("inf")
        while self.now < end:
            wake = min(end, report_at, max(self.now + 1e-9, self.control.next_at(self.now)))
            self.now = wake
            if wake >= report_at:
                report_at = wake + 1.0
                if not any(data == MODE00 and at > wake - 1.0 for at, data, _ in self.sent[-3:]):
                    self.hear()
            self.pump()

    def until(self, so: Callable[[], bool], seconds: float = 30.0) -> None:
        """Let time pass until it is so."""
        end = self.now + seconds
        while not so():
            assert self.now < end, self.sent[-6:]
            self.run(0.05)

    def pump(self) -> None:
        """Write what is to be written."""
        while (write := self.control.poll(self.now)) is not None:
            self.sent.append((self.now, write.data, write.why))
            self.control.wrote(write, self.now)
        self.take()

    def take(self) -> None:
        """Take the records."""
        for record in self.control.take_records():
            if isinstance(record, CommandRecord):
                self.records.append(record)
            elif record.level is not Level.DEBUG:
                self.logs.append(record)

    @property
    def frames(self) -> list[bytes]:
        """What was written."""
        return [data for _, data, _ in self.sent]

    def life(self, identity: str) -> list[Phase]:
        """The phases of a command."""
        return [record.phase for record in self.records if record.command.id == identity]

    def end(self, identity: str) -> tuple[Phase, Reason | None]:
        """How a command ended."""
        record = [record for record in self.records if record.command.id == identity][-1]
        return record.phase, record.reason
