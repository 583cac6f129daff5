"""A fleet of real processes for one test: hub, simulated cars, gateways; everything that was started is ended."""

import contextlib
import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from schemas import bus, messages

PATIENCE_S = 40.0
"""The machine may be busy with other tests; nothing here is waited for longer than it takes."""

TAKEN = ("sent", "queued")
"""Of a command that is carried out; queued: another frame was in flight."""

LONG_S = 60.0
"""A drive that is still on when the next process has been started, and has asked for something."""


SHORTEST_POLL_S = 0.01
LONGEST_POLL_S = 0.05
POLL_SHARE = 0.05
"""Interval of the questions while something is waited for, as a share of the time that was waited so far.

A question is a query of the bus: a hundred a second, of each of four workers, took half of two processors.
"""


def wait_for(so: Callable[..., Any], what: str, seconds: float = PATIENCE_S) -> Any:
    """Ask until it is so; returns what was so."""
    began = time.monotonic()
    while not (found := so()):
        waited_s = time.monotonic() - began
        assert waited_s < seconds, f"never: {what}"
        time.sleep(min(LONGEST_POLL_S, max(SHORTEST_POLL_S, POLL_SHARE * waited_s)))
    return found


class GatewayProcess:
    """One `gateway` process."""

    def __init__(self, arguments: list[str], log: Path, environment: dict[str, str]) -> None:
        self.log = log
        with log.open("w") as stderr:
            self.popen = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=os.environ | environment,
                text=True,
            )
        self.pid = self.popen.pid
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def stderr(self) -> str:
        """What it has said so far."""
        return self.log.read_text()

    def line(self) -> Any:
        """Its next line of JSON."""
        return json.loads(self._lines.get(timeout=PATIENCE_S))

    def lines(self) -> list[str]:
        """Its lines that nobody has read; all, once it has ended."""
        found = []
        while not self._lines.empty():
            found.append(self._lines.get().rstrip("\n"))
        return found

    def say(self, fields: dict[str, Any]) -> Any:
        """Give it a line of JSON, get its answer."""
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps(fields) + "\n")
        self.popen.stdin.flush()
        while "ok" not in (answer := self.line()):
            pass
        assert answer["ok"], answer
        return answer

    def kill(self) -> int:
        """End it without a word; just before that, ns since the epoch."""
        at_ns = time.time_ns()
        self.popen.kill()
        return at_ns

    def rss_mb(self) -> float:
        """What it holds in memory (Linux; elsewhere by `ps`)."""
        listed = subprocess.run(["ps", "-o", "rss=", "-p", str(self.pid)], capture_output=True, text=True, check=True)
        return int(listed.stdout) * 1024 / 1e6

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait; the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Wait until it has ended; the exit code."""
        code = self.popen.wait(PATIENCE_S)
        self._reader.join()
        for stream in (self.popen.stdin, self.popen.stdout):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()
        return code

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self._lines.put(line)


class FleetProcesses:
    """Processes at one endpoint, and a client of their bus."""

    def __init__(self, endpoint: str, directory: Path) -> None:
        self.endpoint = endpoint
        self.directory = directory
        self.environment = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(directory / "state")}
        self._started: list[GatewayProcess] = []
        self._bus: bus.Bus | None = None
        # On a busy machine the first that is its client may come later than a hub waits for one.
        self.hub = self.start("-m", "schemas.bus.hub", "--endpoint", endpoint, "--idle-s", str(2 * PATIENCE_S))
        wait_for(lambda: bus.accepts(endpoint), "the hub listens")

    def start(self, *arguments: str) -> GatewayProcess:
        """Start Python with these arguments."""
        started = GatewayProcess(list(arguments), self.directory / f"{len(self._started)}.log", self.environment)
        self._started.append(started)
        return started

    def simulate(self, *cars: str, truth: bool = False, world: str = "room") -> tuple[GatewayProcess, list[str]]:
        """Simulated cars, and their links; without `truth` they publish none, and are asked."""
        described = [word for car in cars for word in ("--car", car)]
        published = () if truth else ("--no-truth",)
        sim = self.start("-m", "gateway.cli", "sim", *published, "--seed", "3", "--world", world, *described)
        return sim, [sim.line()["link"] for _ in cars]

    def gateway(self, link: str, *more: str, car: str = "red", platform: str = "arduino") -> GatewayProcess:
        """Start `gateway run`."""
        return self.start("-m", "gateway.cli", "run", "--car", car, "--link", link, "--platform", platform, *more)

    @property
    def bus(self) -> bus.Bus:
        """A client of the fleet's bus."""
        if self._bus is None:
            self._bus = bus.Bus.open(self.endpoint, timeout_s=PATIENCE_S)
        return self._bus

    def get(self, selector: str) -> list[Any]:
        """The answers to a query, as messages; an error reply is its words."""
        found: list[Any] = []
        for answer in self.bus.query(selector, timeout_s=5.0):
            found.append(answer.words if isinstance(answer, bus.Failure) else answer.message())
        return found

    def state(self, name: str, car: str = "red") -> Any:
        """One state of one car; None while nobody answers."""
        found = self.get(f"fleet/{car}/state/{name}")
        return next((each for each in found if not isinstance(each, str)), None)

    def ready(self, car: str = "red") -> None:
        """Wait until the car is in a known state."""

        def known() -> bool:
            safety = self.state("safety", car)
            return safety is not None and safety.motors == "off"

        wait_for(known, f"{car} is in a known state")

    def ask(self, verb: str, car: str = "red", **fields: Any) -> Any:
        """Give a command as JSON; the answer as a dict."""
        answers = self.ask_all(verb, car, **fields)
        assert len(answers) == 1, answers
        return answers[0]

    def ask_all(self, verb: str, car: str = "*", **fields: Any) -> list[Any]:
        """Give a command as JSON to every car that matches; the answers."""
        key, payload = f"fleet/{car}/@cmd/{verb}", json.dumps(fields).encode()
        answers = list(self.bus.query(key, payload=payload, encoding=messages.JSON, timeout_s=5.0))
        assert all(isinstance(answer, bus.Sample) for answer in answers), answers
        return [json.loads(answer.payload) for answer in answers if isinstance(answer, bus.Sample)]

    def left(self) -> list[str]:
        """Processes that still run at this endpoint, by the system's own list."""
        listed = subprocess.run(["ps", "-axwwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
        mine = {str(process.pid) for process in self._started}
        found = [line.split(None, 1) for line in listed.splitlines()]
        return [pid for pid, args in found if self.endpoint in args and pid not in mine]

    def close(self) -> None:
        """End everything that was started, and the hubs that gateways have started at this endpoint."""
        if self._bus is not None:
            self._bus.close()
        for process in self._started:
            if process.popen.poll() is None:
                process.popen.kill()
            process.wait()
        for pid in self.left():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGTERM)


def driving(sim: GatewayProcess, car: str = "red") -> bool:
    """Whether the motors of a simulated car are on, says the car."""
    truth = sim.say({"car": car, "ask": "truth"})
    return bool(truth["motor_left"] or truth["motor_right"])


def frames(data: bytes) -> list[bytes]:
    """The frames of one receive; what has no end yet is the last."""
    return re.findall(rb"[^#]*#|[^#]+", data)


MODE00 = b"$4WD,MODE00#"
REPORT = b"$4WD,CSB57.00,PV7.91,GS5,LF0000,HW00,GM11#"
"""What a car in mode 0 sends that has an echo and a good battery."""
PI_REPORT = b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#"
"""The same of a Raspberry Pi, whose voltage and grayscale are constants."""
REPORT_S = 0.95
"""A car in mode 0 reports so often (docs/reference/protocol.md#rates)."""
CLOSING_S = 1.0
"""`MODE00` blocks a car for so long (docs/reference/protocol.md#blocking-times), and so delays its next report."""


def freeze(pid: int) -> None:
    """Stop a process (SIGSTOP), after the end of a pause: `make stress` would resume it."""
    wait_for(lambda: psutil.Process(pid).status() != psutil.STATUS_STOPPED, f"{pid} runs")
    os.kill(pid, signal.SIGSTOP)


class TcpCar:
    """A TCP server that knows nothing of us: it keeps what comes, and sends what it is told to.

    Of writes that one receive brought together, for it was late to ask, each frame is kept by itself; half a frame is
    kept as it came. `echoes`: it sends back all that comes. Until `obey` it shows nothing of what it was sent.
    """

    def __init__(self, *, echoes: bool = False) -> None:
        self._echoes = echoes
        self._report = b""
        self._report_at = float("inf")
        self._turn = threading.Condition()
        self._closed = False
        self._reporter = threading.Thread(target=self._report_on)
        self._reporter.start()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.link = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.received: list[bytes] = []
        self.connections = 0
        self.hung_up = 0
        """Connections whose other end has gone, all that it sent having been kept."""
        self._peers: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Send to the last that connected."""
        self._peers[-1].sendall(data)

    def obey(self, report: bytes = REPORT) -> None:
        """From now on do as a car in mode 0 does: report, and be blocked by each `MODE00`."""
        with self._turn:
            self._report, self._report_at = report, time.monotonic()
            self._turn.notify()

    def pour(self, data: bytes, per_s: float, seconds: float) -> int:
        """Send this over and over; how many bytes were taken."""
        began, sent = time.monotonic(), 0
        while (now := time.monotonic() - began) < seconds:
            while sent < now * per_s and time.monotonic() < began + seconds:
                self.send(data)
                sent += len(data)
            time.sleep(0.001)
        return sent

    def close(self) -> None:
        """Hang up and end."""
        with self._turn:
            self._closed = True
            self._turn.notify()
        self._reporter.join()
        for each in (self._listener, *self._peers):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._thread.join()

    def _serve(self) -> None:
        readers = []
        with contextlib.suppress(OSError):
            while True:
                peer, _ = self._listener.accept()
                peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._peers.append(peer)
                self.connections += 1
                readers.append(threading.Thread(target=self._read, args=(peer,)))
                readers[-1].start()
        for reader in readers:
            reader.join()

    def _read(self, peer: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := peer.recv(4096):
                self.received += frames(data)
                with self._turn:
                    self._report_at += CLOSING_S * data.count(MODE00)
                if self._echoes:
                    peer.sendall(data)
        self.hung_up += 1

    def _report_on(self) -> None:
        with self._turn:
            while not self._closed:
                left_s = min(self._report_at - time.monotonic(), REPORT_S)
                if left_s > 0:
                    self._turn.wait(left_s)
                    continue
                for peer in self._peers:
                    with contextlib.suppress(OSError):  # the other end has gone
                        peer.sendall(self._report)
                self._report_at = time.monotonic() + REPORT_S
