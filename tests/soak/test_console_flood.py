"""Three pupils flood the console of six cars for a minute. Another person's STOP does not notice."""

import contextlib
import json
import socket
import threading
import time
import uuid
from http.client import HTTPException, HTTPSConnection
from pathlib import Path
from statistics import median

import psutil
import pytest
from websockets.exceptions import WebSocketException

from tests.fleet.console.test_server import ServerStage
from tests.support.network_client import NetworkDevice, untrusting
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

FLOOD_S = 60.0
PRESSES = 100
MAX_STOP_S = 0.15
"""Maximum time from the press to the first byte on the wire, of 99 in 100."""
MAX_GROWTH_MB = 30.0
QUIET_S = 60.0
PLAN = "roles:\n" + "".join(f"  role{number}: {{mode: tracking}}\n" for number in range(1800))
"""A plan of 60 kB."""


def flood_socket(pupil: NetworkDevice, over: threading.Event) -> None:
    """Send frames, stops and whistles without a pause. Connect again when closed."""
    texts = ['{"t":"echo","n":1,"press":1}', '{"t":"do","id":1,"verb":"whistle","cars":["red"]}']
    while not over.is_set():
        with contextlib.suppress(WebSocketException, OSError), pupil.socket() as page:
            while not over.is_set():
                for text in (*texts, json.dumps({"t": "stop", "id": uuid.uuid4().hex})):
                    page.send(text)


def flood_requests(pupil: NetworkDevice, over: threading.Event) -> None:
    """Set plans of 60 kB, and stop without a pause."""
    while not over.is_set():
        with contextlib.suppress(OSError, HTTPException):
            pupil.ask("POST", "/plan/check", PLAN)
            pupil.ask("POST", "/stop")


def flood_connections(pupil: NetworkDevice, over: threading.Event) -> None:
    """Open connections, and send half a request in each."""
    while not over.is_set():
        kept = []
        with contextlib.suppress(OSError):
            for _ in range(100):
                raw = socket.create_connection(("127.0.0.1", pupil.port), timeout=5)
                kept.append(untrusting().wrap_socket(raw, server_hostname="127.0.0.1"))
                head = f"POST /plan/check HTTP/1.1\r\nHost: 127.0.0.1:{pupil.port}\r\nOrigin: {pupil.origin}\r\n"
                kept[-1].sendall(f"{head}Cookie: {pupil.cookie}\r\nContent-Length: 50000\r\n\r\nroles".encode())
        over.wait(1.0)
        for each in kept:
            each.close()


def press(connection: HTTPSConnection, teacher: NetworkDevice) -> bool:
    """Press STOP. Return False if the connection was closed: the next request opens another one."""
    try:
        connection.request("POST", "/stop", headers={"Origin": teacher.origin, "Cookie": teacher.cookie})
        response = connection.getresponse()
        response.read()
    except (OSError, HTTPException):
        connection.close()
        return False
    assert response.status == 204
    return True


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_stop_does_not_notice_three_pupils_that_flood(tmp_path: Path) -> None:
    stage = ServerStage(FleetProcesses(free_endpoint(), tmp_path))
    written: list[float] = []
    stage.fleet.bus.subscribe("fleet/red/frame/tx", lambda _: written.append(time.monotonic()))
    teacher = stage.device("teacher")
    server, over = psutil.Process(stage.console.process.popen.pid), threading.Event()
    before_mb = server.memory_info().rss / 1e6
    pupils = [NetworkDevice(stage.lan_port, source=f"127.0.0.{10 + number}") for number in range(3)]
    floods = [flood_socket, flood_requests, flood_connections]
    for number, pupil in enumerate(pupils):
        assert pupil.pair(stage.code(f"pupil{number}"))["ok"]
    threads = [threading.Thread(target=flood, args=(pupil, over)) for pupil in pupils for flood in floods]
    for thread in threads:
        thread.start()
    took_s, again = [], 0
    try:
        connection = teacher.connection()
        for _ in range(PRESSES):
            time.sleep(FLOOD_S / PRESSES)
            count, began = len(written), time.monotonic()
            while not press(connection, teacher):  # a browser opens another connection, too
                again += 1
            wait_for(lambda count=count: len(written) > count, "a frame on the wire")
            took_s.append(written[count] - began)
        most_mb = server.memory_info().rss / 1e6
    finally:
        over.set()
        for thread in threads:
            thread.join()
    time.sleep(QUIET_S)  # memory comes back by itself
    after_mb, took_s = server.memory_info().rss / 1e6, sorted(took_s)
    print(
        f"\nSTOP, from the press to the first frame: p50 {1e3 * median(took_s):.0f} ms, p99 "
        f"{1e3 * took_s[int(0.99 * len(took_s))]:.0f} ms, max {1e3 * took_s[-1]:.0f} ms; "
        f"MB before {before_mb:.0f}, in the flood {most_mb:.0f}, a minute later {after_mb:.0f}; "
        f"{server.num_threads()} threads; the teacher's connection was opened again {again} times"
    )
    assert "Traceback" not in stage.log()
    assert after_mb < before_mb + MAX_GROWTH_MB
    assert took_s[int(0.99 * len(took_s))] <= MAX_STOP_S
    stage.person.close()
    assert stage.console.process.end() == 0
    stage.fleet.close()
