"""A fleet of real processes for one test: hub, simulated cars, gateways. `close` ends all of them."""

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
"""Timeout of each wait, long enough for a machine that is busy with other tests."""

TAKEN = ("sent", "queued")
"""Statuses of an accepted command. `queued`: another frame was in flight."""

LONG_S = 60.0
"""Duration of a drive that goes on until a process that starts later has sent its command."""


SHORTEST_POLL_S = 0.01
LONGEST_POLL_S = 0.2
POLL_SHARE = 0.05
"""Poll interval of a wait, as a share of the time that has passed.

A poll may be a query of the bus. With four workers, a hundred polls a second by each took half of two processors. With
eleven, twenty a second by each still took a tenth of them.
"""


def wait_for(so: Callable[..., Any], what: str, seconds: float = PATIENCE_S) -> Any:
    """Poll until the result is true, and return that result. Fail after the timeout."""
    began = time.monotonic()
    while not (found := so()):
        waited_s = time.monotonic() - began
        assert waited_s < seconds, f"never: {what}"
        time.sleep(min(LONGEST_POLL_S, max(SHORTEST_POLL_S, POLL_SHARE * waited_s)))
    return found


class GatewayProcess:
    """One Python process: a gateway, a hub, a simulator or a command."""

    def __init__(self, arguments: list[str], log: Path, environment: dict[str, str]) -> None:
        self.log = log
        with log.open("w") as stderr:
            self.popen = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env={name: value for name, value in os.environ.items() if name != "COLUMNS"} | environment,  # of xdist
                text=True,
            )
        self.pid = self.popen.pid
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def stderr(self) -> str:
        """Return the process's output on stderr until now."""
        return self.log.read_text()

    def line(self) -> Any:
        """Wait for the process's next line of JSON, and return its value."""
        return json.loads(self._lines.get(timeout=PATIENCE_S))

    def lines(self) -> list[str]:
        """Return the process's unread lines: after its end, all that are left."""
        found = []
        while not self._lines.empty():
            found.append(self._lines.get().rstrip("\n"))
        return found

    def say(self, fields: dict[str, Any]) -> Any:
        """Write a line of JSON to the process's stdin. Return the answer."""
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps(fields) + "\n")
        self.popen.stdin.flush()
        while "ok" not in (answer := self.line()):
            pass
        assert answer["ok"], answer
        return answer

    def kill(self) -> int:
        """Kill the process. Return the time just before, ns since the epoch."""
        at_ns = time.time_ns()
        self.popen.kill()
        return at_ns

    def rss_mb(self) -> float:
        """Return the process's resident memory by `ps`, MB."""
        listed = subprocess.run(["ps", "-o", "rss=", "-p", str(self.pid)], capture_output=True, text=True, check=True)
        return int(listed.stdout) * 1024 / 1e6

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, and wait for the end. Return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Wait for the end of the process. Return the exit code."""
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
        self.hub = self.start_hub()

    def start_hub(self) -> GatewayProcess:
        """Start a hub, and wait until it listens."""
        # On a busy machine, the first client may come later than a hub waits for one.
        hub = self.start("-m", "schemas.bus.hub", "--endpoint", self.endpoint, "--idle-s", str(2 * PATIENCE_S))
        wait_for(lambda: bus.accepts(self.endpoint), "the hub listens")
        return hub

    def start(self, *arguments: str) -> GatewayProcess:
        """Start Python with these arguments."""
        started = GatewayProcess(list(arguments), self.directory / f"{len(self._started)}.log", self.environment)
        self._started.append(started)
        return started

    def simulate(self, *cars: str, truth: bool = False, world: str = "room") -> tuple[GatewayProcess, list[str]]:
        """Start simulated cars. Return process and links. Without `truth`, no car publishes its true state."""
        described = [word for car in cars for word in ("--car", car)]
        published = () if truth else ("--no-truth",)
        sim = self.start("-m", "gateway.cli", "sim", *published, "--seed", "3", "--world", world, *described)
        return sim, [sim.line()["link"] for _ in cars]

    def gateway(self, link: str, *more: str, car: str = "red", platform: str = "arduino") -> GatewayProcess:
        """Start `gateway run`."""
        return self.start("-m", "gateway.cli", "run", "--car", car, "--link", link, "--platform", platform, *more)

    @property
    def bus(self) -> bus.Bus:
        """Return a client of the fleet's bus."""
        if self._bus is None:
            self._bus = bus.Bus.open(self.endpoint, timeout_s=PATIENCE_S)
        return self._bus

    def get(self, selector: str) -> list[Any]:
        """Return the answers to a query as messages, and error replies as texts."""
        found: list[Any] = []
        for answer in self.bus.query(selector, timeout_s=5.0):
            found.append(answer.words if isinstance(answer, bus.Failure) else answer.message())
        return found

    def state(self, name: str, car: str = "red") -> Any:
        """Return one state of one car, None if no gateway answers."""
        found = self.get(f"fleet/{car}/state/{name}")
        return next((each for each in found if not isinstance(each, str)), None)

    def ready(self, car: str = "red") -> None:
        """Wait until the gateway claims that the motors are off."""

        def known() -> bool:
            safety = self.state("safety", car)
            return safety is not None and safety.motors == "off"

        wait_for(known, f"{car} is in a known state")

    def ask(self, verb: str, car: str = "red", **fields: Any) -> Any:
        """Send a command as JSON, and return the answer as a dict."""
        answers = self.ask_all(verb, car, **fields)
        assert len(answers) == 1, answers
        return answers[0]

    def ask_all(self, verb: str, car: str = "*", **fields: Any) -> list[Any]:
        """Send a command as JSON to every matching car, and return the answers."""
        key, payload = f"fleet/{car}/@cmd/{verb}", json.dumps(fields).encode()
        answers = list(self.bus.query(key, payload=payload, encoding=messages.JSON, timeout_s=5.0))
        assert all(isinstance(answer, bus.Sample) for answer in answers), answers
        return [json.loads(answer.payload) for answer in answers if isinstance(answer, bus.Sample)]

    def left(self) -> list[str]:
        """Return the ids of processes at this endpoint that `start` has not started, by the system's own list."""
        listed = subprocess.run(["ps", "-axwwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
        mine = {str(process.pid) for process in self._started}
        found = [line.split(None, 1) for line in listed.splitlines()]
        return [pid for pid, args in found if self.endpoint in args and pid not in mine]

    def close(self) -> None:
        """End all started processes, and the hubs that gateways have started at this endpoint."""
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
    """Return True if the motors of a simulated car are on, by the car's own answer."""
    truth = sim.say({"car": car, "ask": "truth"})
    return bool(truth["motor_left"] or truth["motor_right"])


def frames(data: bytes) -> list[bytes]:
    """Return the frames of one receive. The last one may lack its end."""
    return re.findall(rb"[^#]*#|[^#]+", data)


MODE00 = b"$4WD,MODE00#"
REPORT = b"$4WD,CSB57.00,PV7.91,GS5,LF0000,HW00,GM11#"
"""A report of a car in mode 0, with an echo and a good battery."""
PI_REPORT = b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#"
"""The same report of a Raspberry Pi car, whose voltage and grayscale are constants."""
REPORT_S = 0.95
"""Interval of the reports in mode 0 (docs/reference/protocol.md#rates)."""
CLOSING_S = 1.0
"""Time for which `MODE00` blocks a car and delays its report (docs/reference/protocol.md#blocking-times)."""


def freeze(pid: int) -> None:
    """Stop a process by SIGSTOP. Wait for the end of a pause first, because `make stress` would resume the process."""
    wait_for(lambda: psutil.Process(pid).status() != psutil.STATUS_STOPPED, f"{pid} runs")
    os.kill(pid, signal.SIGSTOP)


class TcpCar:
    """A plain TCP server in place of a car: it stores received frames, and sends the data of `send`.

    One receive may hold several writes: each frame is stored by itself, and half a frame as received. `echoes`: the
    server sends all received bytes back. Until `obey`, it reacts to no frame.
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
        """Number of connections that the other end has closed, with all their data stored."""
        self._peers: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Send data to the newest connection."""
        self._peers[-1].sendall(data)

    def obey(self, report: bytes = REPORT) -> None:
        """Behave as a car in mode 0 from now on: send reports, and block after each `MODE00`."""
        with self._turn:
            self._report, self._report_at = report, time.monotonic()
            self._turn.notify()

    def pour(self, data: bytes, per_s: float, seconds: float) -> int:
        """Send data repeatedly at `per_s` bytes a second. Return the number of sent bytes."""
        began, sent = time.monotonic(), 0
        while (now := time.monotonic() - began) < seconds:
            while sent < now * per_s and time.monotonic() < began + seconds:
                self.send(data)
                sent += len(data)
            time.sleep(0.001)
        return sent

    def close(self) -> None:
        """Close all connections and end."""
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
                    with contextlib.suppress(OSError):  # the other end has closed the connection
                        peer.sendall(self._report)
                self._report_at = time.monotonic() + REPORT_S
