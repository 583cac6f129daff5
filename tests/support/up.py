"""`fleet up` as a process: its events, its status, its processes. The end of the `with` ends all processes it left."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import pytest

from fleet import cli
from fleet.client.supervision import ask_status
from schemas import messages
from schemas.bus import Bus, BusError, Sample
from tests.support.message_length import too_long
from tests.support.processes import GatewayProcess, wait_for


def fleet_command(*arguments: str, environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    """Run `fleet` from its entry point in this process, because a new process takes half a second of CPU time."""
    # A text layer on bytes, as a real stdout has: tables are written as bytes.
    stdout, stderr = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patched,
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        patched.setattr(sys, "argv", ["fleet", *arguments])
        for name, value in environment.items():
            patched.setenv(name, value)
        try:
            cli.main()
            code: object = 0
        except SystemExit as ended:
            code = ended.code
    assert code is None or isinstance(code, int), code
    assert too_long(stderr.getvalue()) == [], (arguments, stderr.getvalue())
    stdout.seek(0)
    return subprocess.CompletedProcess(arguments, code or 0, stdout.read(), stderr.getvalue())


class Up:
    """One `fleet up --json`, for a `with` statement."""

    def __init__(self, directory: Path, endpoint: str, *arguments: str) -> None:
        self.directory = directory
        self.endpoint = endpoint
        self.environment = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(directory / "state")}
        self.out = directory / "sessions"
        self.began = time.perf_counter()
        words = ["-m", "fleet.cli", "up", *arguments, "--sessions", str(self.out), "--json"]
        self.process = GatewayProcess(words, directory / "up.log", self.environment)
        self.heard: list[dict[str, Any]] = []
        self._bus: Bus | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bus is not None:
            self._bus.close()
        if self.process.popen.poll() is None:
            self.process.popen.kill()
        self.process.wait()
        wait_for(lambda: not self.left(ours=True), "its children end with it")
        for pid in self.left():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)

    def left(self, *, ours: bool = False) -> list[int]:
        """Return the ids of other processes at this endpoint, by the system's own list. `ours`: without the hub."""
        return [pid for pid, words in self._mine() if not (ours and "schemas.bus.hub" in words)]

    def _mine(self) -> list[tuple[int, str]]:
        listed = subprocess.run(["ps", "-axwwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
        found = [line.split(None, 1) for line in listed.splitlines()]
        return [(int(pid), words) for pid, words in found if self.endpoint in words and int(pid) != self.process.pid]

    @property
    def bus(self) -> Bus:
        """Return a client of the fleet's bus."""
        if self._bus is None:
            self._bus = wait_for(self._open, "there is a bus")
        return self._bus

    def _open(self) -> Bus | None:
        with contextlib.suppress(BusError):
            return Bus.open(self.endpoint)
        return None

    def until(self, what: str, name: str, words: str) -> dict[str, Any]:
        """Wait for the next event of this kind, and return it."""
        while True:
            said: dict[str, Any] = self.process.line()
            self.heard.append(said)
            if (said["what"], said["name"]) == (what, name) and words in said["words"]:
                return said

    def simulator(self, **fields: Any) -> Any:
        """Send a request to the simulator, and return its answer."""
        assert self.process.popen.stdin is not None
        self.process.popen.stdin.write(json.dumps(fields) + "\n")
        self.process.popen.stdin.flush()
        return json.loads(self.until("simulator", "@simulator", "ok")["words"])

    def status(self) -> Any:
        """Return the supervisor's status, None without an answer."""
        return next(iter(ask_status(self.bus, "fleet")), None)

    def processes(self) -> list[Any]:
        """Wait until the supervisor answers, as it may be on its way back to the bus. Return its processes."""
        return list(wait_for(self.status, "it answers").processes)

    def state(self, name: str) -> Any:
        """Wait until the supervisor answers. Return the state of one process, None if there is none."""
        return next((each for each in self.processes() if each.name == name), None)

    def running(self, name: str, but: int = 0) -> int:
        """Wait until a process runs with another id than `but`. Return its id (1 for a hub that a gateway started)."""

        def pid() -> int | None:
            found = self.state(name)
            if found is not None and found.state == "elsewhere":
                return 1
            return found.pid if found is not None and found.state == "running" and found.pid != but else None

        return int(wait_for(pid, f"{name} runs"))

    def kill(self, pid: int) -> None:
        """Kill a process of this fleet."""
        os.kill(pid, signal.SIGKILL)

    def exists(self, pid: int) -> bool:
        """Return True if the process exists and is no zombie, as a gateway's ended hub is."""
        listed = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False)
        return listed.stdout.strip()[:1] not in ("", "Z")

    def hub(self) -> int:
        """Return the id of the hub by the system's own list: the supervisor's, or a hub that a gateway started."""

        def one() -> int | None:
            return next((pid for pid, words in self._mine() if "schemas.bus.hub" in words), None)

        return int(wait_for(one, "there is a hub"))

    def get(self, key: str) -> Any:
        """Return the latest value, None without an answer."""
        for answer in self.bus.query(f"fleet/{key}", timeout_s=5.0):
            if isinstance(answer, Sample):
                return answer.message()
        return None

    def ready(self, car: str) -> None:
        """Wait until the gateway claims that the motors are off."""
        wait_for(lambda: (safety := self.get(f"{car}/state/safety")) and safety.motors == "off", f"{car} is ready")

    def ask(self, verb: str, car: str, **fields: Any) -> Any:
        """Send a command as JSON, and return the answer."""
        key = f"fleet/{car}/@cmd/{verb}"
        payload = json.dumps(fields).encode()
        (answer,) = self.bus.query(key, payload=payload, encoding=messages.JSON, timeout_s=5.0)
        assert isinstance(answer, Sample)
        return json.loads(answer.payload)

    def fleet(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Run another `fleet` command for this fleet, in this process."""
        return fleet_command(*arguments, environment=self.environment)

    def fleet_process(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Run another `fleet` command for this fleet in a process of its own. Any thread may call it."""
        command = [sys.executable, "-m", "fleet.cli", *arguments]
        environment = os.environ | self.environment
        return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=90)
