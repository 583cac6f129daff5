"""Costs of certificates and rules: a command, a gateway's CPU and start. The floor is the same on a bus without them.

The benchmark also measures how long a computer takes to join.
"""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from time import monotonic, perf_counter, sleep

import psutil
import zenoh

from fleet.hub.hub_store import HubStore
from fleet.hub.invitation import Invitation
from fleet.hub.join import join
from schemas import keys
from schemas.bus.credentials import Credentials
from schemas.identity import car, person
from tests.bench.commands import COMMANDS, GAP_S, TURNS
from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import READING, Arrival, Tty, frames, play_car, scratch
from tests.support.ports import free_endpoint, free_port
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess
from tests.support.secure import client_of, secure_fleet, stranger

ANN, RED = person("ann"), car("red")
LOAD_HZ = 25.0
LOAD_S = 10.0
JOIN_S = 10.0


class SecureBench:
    """One bus with a gateway on a PTY, and a plain Zenoh client of it."""

    def __init__(self, fleet: FleetProcesses, session: zenoh.Session, identity: str) -> None:
        self._session = session
        self._fleet = fleet
        self._identity = identity
        self._port = Tty()
        self._gateway = self._start()

    def _start(self) -> GatewayProcess:
        process = self._fleet.gateway(self._port.path)

        def known() -> bool:
            safety = self._fleet.state("safety")
            return safety is not None and safety.motors == "off"

        play_car(self._port, known)
        return process

    def command(self, count: int) -> float:
        """Return the median time from a drive's query to its frame on the tty, ms."""
        times = []
        with frames(self._port, READING, rate_hz=1.0):
            for _ in range(count):
                motion, frame = next(TURNS)
                fields = {"motion": motion, "duration_s": 5, "sender": "ann@bench", "kind": "person"}
                sleep(GAP_S)
                self._port.drain()
                began = perf_counter()
                key = keys.command_key("fleet", "red", "drive", self._identity)
                replies = self._session.get(key, payload=json.dumps(fields), encoding="application/json")
                seen = b""
                deadline = monotonic() + PATIENCE_S
                while frame not in seen:
                    assert monotonic() < deadline, seen
                    seen += self._port.read()
                times.append((perf_counter() - began) * 1e3)
                assert all(reply.ok is not None for reply in replies)
        return median(times[1:])

    def cpu(self, seconds: float) -> float:
        """Return the share of a processor that the gateway takes while its car reports as fast as it can, %."""
        process = psutil.Process(self._gateway.pid)
        with frames(self._port, READING, rate_hz=LOAD_HZ):
            before = process.cpu_times()
            sleep(seconds)
            after = process.cpu_times()
        return (after.user + after.system - before.user - before.system) / seconds * 100

    def start(self) -> float:
        """Return the time from the start of a gateway to its token, ms."""
        gone, alive = Arrival(), Arrival()
        watch = self._session.liveliness().declare_subscriber(
            "fleet/red", lambda sample: (alive if sample.kind == sample.kind.PUT else gone).note()
        )
        self._gateway.kill()
        self._gateway.wait()
        gone.wait()
        began = perf_counter()
        self._gateway = self._fleet.gateway(self._port.path)
        took_ms = (alive.wait() - began) * 1e3
        watch.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        return took_ms

    def close(self) -> None:
        """Close the PTY."""
        self._gateway.kill()
        self._gateway.wait()
        self._port.close()


@contextlib.contextmanager
def _plain(directory: Path) -> Iterator[SecureBench]:
    fleet = FleetProcesses(free_endpoint(), directory)
    settings = {
        "mode": "client",
        "connect": {"endpoints": [fleet.endpoint]},
        "scouting": {"multicast": {"enabled": False}},
    }
    with contextlib.closing(fleet), zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as session:
        bench = SecureBench(fleet, session, "")
        with contextlib.closing(bench):
            yield bench


@contextlib.contextmanager
def _secure(directory: Path) -> Iterator[tuple[SecureBench, Credentials]]:
    with secure_fleet(directory, ANN, [RED]) as (fleet, store), client_of(store.credentials, ANN) as session:
        bench = SecureBench(fleet, session, ANN)
        with contextlib.closing(bench):
            yield bench, store.credentials


def _join(credentials: Credentials) -> float:
    """Return the time from the code to a link of whoever has joined, s."""
    began = perf_counter()
    store = HubStore.load(credentials)
    store.reserve(person("mia"))
    invitation = Invitation(store, person("mia"), hub_port=1, address="127.0.0.1", port=free_port())
    joined = join("127.0.0.1", invitation.code, invitation.port)
    invitation.close()
    for name, data in (("mia.pem", joined.certificate), ("mia.key", joined.key)):
        (credentials.directory / name).write_bytes(data)
    paths = {
        "root_ca_certificate": str(credentials.directory / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": str(credentials.directory / "mia.pem"),
        "connect_private_key": str(credentials.directory / "mia.key"),
    }
    answered = False
    while not answered:
        assert perf_counter() - began < PATIENCE_S, "no gateway answers whoever has joined"
        with contextlib.suppress(zenoh.ZError), stranger(credentials, **paths) as session:
            answered = any(reply.ok is not None for reply in session.get("fleet/red/state/health"))
    return perf_counter() - began


def run(scale: Scale) -> list[Measured]:
    with scratch() as directory:
        (directory / "plain").mkdir()
        (directory / "secure").mkdir()
        with _plain(directory / "plain") as plain, _secure(directory / "secure") as (secure, credentials):
            count, seconds = scale.count(COMMANDS, 3), scale.seconds(LOAD_S, 1.0)
            commands = in_turns(scale, lambda: secure.command(count), lambda: plain.command(count))
            cpu = in_turns(scale, lambda: secure.cpu(seconds), lambda: plain.cpu(seconds))
            starts = in_turns(scale, secure.start, plain.start)
            joins = [_join(credentials) for _ in range(scale.runs)]
    return [
        Measured("certificates: command to tty, p50", tuple(commands[0]), tuple(commands[1]), "ms", 1.0, slack=2.0),
        Measured("certificates: CPU of a gateway at 25 Hz", tuple(cpu[0]), tuple(cpu[1]), "%", 1.2),
        Measured("certificates: gateway start to token", tuple(starts[0]), tuple(starts[1]), "ms", 1.3),
        Measured("certificates: a computer joins", tuple(joins), (JOIN_S,), "s", 1.0),
    ]
