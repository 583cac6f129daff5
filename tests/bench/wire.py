"""From the tty to a subscriber, and from a command to the tty, through a real `gateway run` on a PTY."""

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from tests.bench import floors
from tests.bench.measure import ROUNDS, Measured, hub, process, quantile, wait_for

SAMPLES = 60
GAP_S = 0.03
MANUAL = b"$4WD,CSB57.24,PV7.91,GS214,LF0000,HW00,GM00#"


class Tty:
    """The car's end of a PTY: says a mode-0 reading twice a second until told otherwise, and hears what is written."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self.talks = True
        self._ended = False
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()

    def _talk(self) -> None:
        while not self._ended:
            if self.talks:
                os.write(self.master, MANUAL)
            time.sleep(0.5)

    def hear(self, seconds: float) -> bytes:
        """What was written to the car, as soon as something is."""
        ready, _, _ = select.select([self.master], [], [], seconds)
        return os.read(self.master, 4096) if ready else b""

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


@contextmanager
def _gateway(endpoint: str, line: Tty) -> Iterator[None]:
    with process(
        "gateway.cli", "run", "--car", "red", "--link", line.path, "--platform", "arduino", "--connect", endpoint
    ):
        yield


def run() -> list[Measured]:
    with hub() as endpoint, floors.session(endpoint) as session:
        ours, floor = Tty(), Tty()
        with _gateway(endpoint, ours), process("tests.bench.floors", "relay", endpoint, floor.path, "floor/rx"):
            lines = _up(session, ours, floor)
            commands = _down(endpoint, session, ours)
        ours.close()
        floor.close()
    return [*lines, *commands]


def _up(session: zenoh.Session, ours: Tty, floor: Tty) -> list[Measured]:
    came = threading.Event()
    subscribers = [
        session.declare_subscriber(key, lambda _: came.set()) for key in ("fleet/red/sensor/range", "floor/rx")
    ]
    wait_for(lambda: _known(session))
    ours.talks = floor.talks = False
    time.sleep(1.0)

    def delays(line: Tty) -> list[float]:
        took = []
        while line.hear(0.0):
            pass
        for _ in range(SAMPLES):
            came.clear()
            began = time.perf_counter()
            os.write(line.master, MANUAL)
            if came.wait(1.0):
                took.append((time.perf_counter() - began) * 1e3)
            time.sleep(GAP_S)
        return took

    taken = [(delays(floor), delays(ours)) for _ in range(ROUNDS)]
    ours.talks = True
    for subscriber in subscribers:
        subscriber.undeclare()
    found = []
    for name, share in (("p50", 0.5), ("p90", 0.9)):
        middle = [sorted(quantile(each[index], share) for each in taken)[ROUNDS // 2] for index in (1, 0)]
        found.append(Measured(f"tty write to subscriber, {name}", *middle, "ms", 1.5))
    return found


def _known(session: zenoh.Session) -> bool:
    for reply in session.get("fleet/red/state/safety"):
        if reply.ok is not None:
            safety = pb.Safety.FromString(reply.ok.payload.to_bytes())
            return safety.motors == "off"
    return False


def _down(endpoint: str, session: zenoh.Session, ours: Tty) -> list[Measured]:
    payload = pb.LightCommand(light="green").SerializeToString()
    encoding = messages.encoding_of("fleet.v1.LightCommand")

    def command() -> float:
        while ours.hear(0.0):
            pass
        began = time.perf_counter()
        replies = session.get("fleet/red/@cmd/light", payload=payload, encoding=encoding)
        heard = ours.hear(2.0)
        took = (time.perf_counter() - began) * 1e3
        assert heard.startswith(b"$0,0,0,0,0,0,3"), heard
        list(replies)
        time.sleep(0.08)
        return took

    def query() -> float:
        began = time.perf_counter()
        list(session.get("floor/answer"))
        took = (time.perf_counter() - began) * 1e3
        time.sleep(GAP_S)
        return took

    with process("tests.bench.floors", "answer", endpoint, "floor/answer"):
        wait_for(lambda: list(session.get("floor/answer")))
        taken = [([query() for _ in range(40)], [command() for _ in range(40)]) for _ in range(ROUNDS)]
    found = []
    for name, share in (("p50", 0.5), ("p90", 0.9)):
        middle = [sorted(quantile(each[index], share) for each in taken)[ROUNDS // 2] for index in (1, 0)]
        found.append(Measured(f"command to tty, {name}", *middle, "ms", 1.5, slack=1.0))
    return found
