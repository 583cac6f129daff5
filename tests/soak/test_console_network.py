"""The console from another network namespace, through an attacker that records each byte. Needs root and iproute2."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.console import ConsoleProcess
from tests.support.network_client import NetworkDevice, find_line, first_code, network_port
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses
from tests.support.tcp_proxy import TcpProxy

pytestmark = [
    pytest.mark.soak,
    pytest.mark.skipif(os.geteuid() != 0 or shutil.which("ip") is None, reason="needs root and iproute2 (ip netns)"),
]

HERE, THERE = "10.231.77.1", "10.231.77.2"
ROOT = Path(__file__).parents[2]
VISITOR = """
import json, sys
from tests.support.network_client import NetworkDevice
device = NetworkDevice(int(sys.argv[2]), sys.argv[1])
for line in sys.stdin:
    verb, path, body, cookie = json.loads(line)
    device.cookie = device.cookie if cookie is None else cookie
    try:
        status, text = device.ask(verb, path, body)
    except OSError as error:
        status, text = 0, str(error).encode()
    print(json.dumps([status, text.decode(errors="replace"), device.cookie]), flush=True)
"""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@pytest.fixture
def namespace() -> Iterator[str]:
    """Yield the name of a network namespace, connected as another computer is."""
    name = f"fleet-{os.getpid()}"
    ip("netns", "add", name)
    try:
        ip("link", "add", "fleet-here", "type", "veth", "peer", "name", "fleet-there", "netns", name)
        ip("address", "add", f"{HERE}/24", "dev", "fleet-here")
        ip("link", "set", "fleet-here", "up")
        ip("-n", name, "address", "add", f"{THERE}/24", "dev", "fleet-there")
        ip("-n", name, "link", "set", "fleet-there", "up")
        ip("-n", name, "link", "set", "lo", "up")
        yield name
    finally:
        ip("netns", "del", name)  # this also deletes the connection
        with contextlib.suppress(subprocess.CalledProcessError):
            ip("link", "del", "fleet-here")


class Visitor:
    """A device in the other namespace."""

    def __init__(self, namespace: str, host: str, port: int) -> None:
        words = ["ip", "netns", "exec", namespace, sys.executable, "-c", VISITOR, host, str(port)]
        self._popen = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)

    def ask(self, verb: str, path: str, body: str | None = None, cookie: str | None = None) -> tuple[int, str, str]:
        """Send a request. Return status (0: no connection), text and the new cookie."""
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        print(json.dumps([verb, path, body, cookie]), file=self._popen.stdin, flush=True)
        status, text, cookie_now = json.loads(self._popen.stdout.readline())
        return status, text, cookie_now

    def close(self) -> None:
        """End the device's process."""
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._popen.stdin.close()
        self._popen.wait(timeout=PATIENCE_S)
        self._popen.stdout.close()


class Eavesdropper(TcpProxy):
    """An attacker in the network who passes each byte on and records it."""

    def __init__(self, host: str, port: int) -> None:
        self._sent: dict[int, bytes] = defaultdict(bytes)
        super().__init__(port, host)

    @property
    def sent(self) -> list[bytes]:
        """Bytes of each client, by connection."""
        return [self._sent[number] for number in range(self.connections)]

    def on_bytes(self, data: bytes, connection: int, *, from_client: bool) -> None:
        """Record the bytes of a client."""
        if from_client:
            self._sent[connection] += data

    def on_end(self, source: socket.socket, sink: socket.socket) -> None:
        """Close both ends when one has ended."""
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


def replay(host: str, port: int, recorded: bytes) -> bytes:
    """Send recorded bytes again. Return the console's bytes until it closes the connection."""
    answer = b""
    with socket.create_connection((host, port), timeout=PATIENCE_S) as again, contextlib.suppress(OSError):
        again.sendall(recorded)
        while data := again.recv(65536):
            answer += data
    return answer


def test_from_another_computer_nothing_is_served_without_pairing(namespace: str, tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    opened: list[Any] = []
    try:
        console = ConsoleProcess(fleet, "--lan", "--lan-port", "0")
        port, code = network_port(console), first_code(console)
        find_line(console, r"Certificate SHA-256: ((?:[0-9A-F]{2}:){31}[0-9A-F]{2})$")
        opened.append(loopback_side := Visitor(namespace, HERE, console.port))
        assert loopback_side.ask("GET", "/")[0] == 0, "the port of this computer is closed to others"
        opened.append(stranger := Visitor(namespace, HERE, port))
        assert stranger.ask("GET", "/")[:2] == (303, "")
        for path in ("/hello", "/people", "/static/app.js", "/static/index.html", "/sessions", "/ws"):
            assert stranger.ask("GET", path)[0] == 403, path
        for path in ("/stop", "/plan/set", "/people"):
            assert stranger.ask("POST", path, "{}")[0] == 403, path
        # The right code pairs, from the other computer.
        assert json.loads(stranger.ask("POST", "/pair", "AAAA-AAAA")[1])["ok"] is False
        status, _, cookie = stranger.ask("POST", "/pair", code)
        assert (status, cookie != "") == (200, True)
        assert stranger.ask("GET", "/hello")[0] == 200
        assert stranger.ask("POST", "/stop")[0] == 204
        # Another device sends the same code.
        opened.append(second := Visitor(namespace, HERE, port))
        assert json.loads(second.ask("POST", "/pair", code)[1])["ok"] is False
        assert second.ask("GET", "/hello")[0] == 403

        # A whole recorded exchange, byte by byte: its pairing, then its STOP.
        opened.append(wire := Eavesdropper("127.0.0.1", port))
        victim = NetworkDevice(wire.port)
        # The browser takes the attacker's port for the console's own.
        victim.origin = f"https://127.0.0.1:{port}"
        environment = os.environ | fleet.environment
        words = [sys.executable, "-m", "fleet.cli", "console", "pair", "victim"]
        made = subprocess.run(words, env=environment, capture_output=True, text=True, check=True, cwd=ROOT).stdout
        fresh = made.split(" type ")[1][:9]
        assert victim.ask("POST", "/pair", fresh, Host=f"127.0.0.1:{port}")[0] == 200
        assert victim.ask("POST", "/stop", Host=f"127.0.0.1:{port}")[0] == 204
        time.sleep(0.2)  # until the last bytes of the closed connections have passed
        before = console.process.stderr
        assert len(wire.sent) == 2
        for recorded in wire.sent:
            assert fresh.encode() not in recorded
            answer = replay("127.0.0.1", port, recorded)
            assert b"HTTP/1.1" not in answer
            assert len(answer) < 4096, "a handshake and an alert"
        listed = [sys.executable, "-m", "fleet.cli", "console", "people", "--json"]
        people = subprocess.run(listed, env=environment, capture_output=True, text=True, check=True, cwd=ROOT).stdout
        assert people.count('"victim"') == 1
        assert console.process.stderr.count("paired as") == before.count("paired as") == 2
        assert "Traceback" not in console.process.stderr
        assert console.process.end() == 0
    finally:
        for each in opened:
            each.close()
        fleet.close()
