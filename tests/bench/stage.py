"""The stage of a benchmark: a hub of its own, processes, a PTY. Its end ends all started processes."""

import contextlib
import os
import select
import tempfile
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic, perf_counter
from typing import Any

import zenoh

from tests.support.ports import free_endpoint
from tests.support.processes import CLOSING_S, MODE00, PATIENCE_S, REPORT_S, FleetProcesses, GatewayProcess

FLOORS = Path(__file__).parent / "floors"
SCRATCH = Path(__file__).resolve().parents[2] / ".tmp"
READING = b"$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#"
LOOK_S = 0.1
"""Poll interval of the gateway's state."""


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield a directory inside the clone, and remove it afterwards."""
    SCRATCH.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=SCRATCH, prefix="bench-") as directory:
        yield Path(directory)


class Tty:
    """A PTY. This process has the car's end, and `path` is the port."""

    def __init__(self) -> None:
        self._car, self._port = os.openpty()
        tty.setraw(self._port)
        self.path = os.ttyname(self._port)

    def write(self, data: bytes) -> None:
        os.write(self._car, data)

    def read(self, timeout_s: float = PATIENCE_S) -> bytes:
        """Wait for bytes and return them. Return empty bytes after the timeout."""
        ready, _, _ = select.select([self._car], [], [], timeout_s)
        return os.read(self._car, 4096) if ready else b""

    def drain(self, quiet_s: float = 0.0) -> None:
        """Read until no byte has come for `quiet_s`."""
        while self.read(quiet_s):
            pass

    def close(self) -> None:
        os.close(self._car)
        os.close(self._port)


@contextlib.contextmanager
def frames(port: Tty, frame: bytes, rate_hz: float) -> Iterator[None]:
    """Write a frame at a rate, on a thread of its own."""
    over = threading.Event()

    def send() -> None:
        due = monotonic()
        while not over.wait(max(0.0, due - monotonic())):
            port.write(frame)
            due += 1 / rate_hz

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def play_car(port: Tty, until: Callable[[], bool], report: Callable[[], bytes] = lambda: READING) -> None:
    """Send reports as a car in mode 0 does, and block after each `MODE00`, until a condition holds."""
    deadline = monotonic() + PATIENCE_S
    report_at = monotonic()
    while not until():
        assert monotonic() < deadline, "the gateway does not take this for a car that obeys"
        report_at += CLOSING_S * port.read(max(0.0, min(report_at - monotonic(), LOOK_S))).count(MODE00)
        if monotonic() >= report_at:
            port.write(report())
            report_at = monotonic() + REPORT_S


class Stage:
    """A hub, its endpoint, and a bare session to it."""

    def __init__(self, directory: Path) -> None:
        self.fleet = FleetProcesses(free_endpoint(), directory)
        # If Python may not write compiled modules, every start would be measured as a first start.
        self.fleet.environment["PYTHONDONTWRITEBYTECODE"] = ""
        self._ttys: list[Tty] = []
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{self.fleet.endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)

    def bare(self, name: str, *arguments: str) -> GatewayProcess:
        """Start the program of a floor, which uses no code of ours."""
        return self.fleet.start(str(FLOORS / f"{name}.py"), self.fleet.endpoint, *arguments)

    def tty(self) -> Tty:
        """Return a new PTY."""
        self._ttys.append(Tty())
        return self._ttys[-1]

    def gateway(self, port: Tty) -> GatewayProcess:
        """Start a gateway and play the car until the gateway knows that the car stands."""
        process = self.fleet.gateway(port.path)

        def known() -> bool:
            safety = self.fleet.state("safety")
            return safety is not None and safety.motors == "off"

        play_car(port, known)
        return process

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        self.fleet.close()
        for each in self._ttys:
            each.close()


@contextlib.contextmanager
def stage() -> Iterator[Stage]:
    """Yield a stage, and end it afterwards."""
    with scratch() as directory:
        built = Stage(directory)
        try:
            yield built
        finally:
            built.close()


class Arrival:
    """The time of the next arrival, noted on the thread that received it."""

    def __init__(self) -> None:
        self._came = threading.Event()
        self._at = 0.0

    def note(self, *_: Any) -> None:
        self._at = perf_counter()
        self._came.set()

    def wait(self) -> float:
        """Wait for the arrival, and return its time by `perf_counter`. Then reset, for the next one."""
        assert self._came.wait(PATIENCE_S), "nothing came"
        self._came.clear()
        return self._at
