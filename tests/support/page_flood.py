"""Paired devices that flood the console, each in a process of its own: a thread of the test would hold up its clock.

`python -m tests.support.page_flood PORT ADDRESS COOKIE KIND ...` floods until SIGTERM, then prints what it got as JSON.
"""

import contextlib
import json
import signal
import socket
import sys
import threading
import uuid
from collections import Counter
from collections.abc import Callable
from http.client import HTTPException
from typing import Final

from websockets.exceptions import WebSocketException

from tests.support.network_client import NetworkDevice, untrusting
from tests.support.processes import FleetProcesses, GatewayProcess

PLAN: Final = "roles:\n" + "".join(f"  role{number}: {{mode: tracking}}\n" for number in range(2070))
"""A plan of 60 kB."""
HALF_REQUESTS: Final = 192
"""Half requests of one device at once, as the issue had them."""
BETWEEN_HALVES_S: Final = 1.0
"""Time that half requests stay: longer than the console needs to end those that are too many."""


def flood_messages(pupil: NetworkDevice, over: threading.Event, counts: Counter[str]) -> None:
    """Send echoes and whistles without a pause. Connect again when closed."""
    _flood_socket(pupil, over, counts, lambda: None)


def flood_stops(pupil: NetworkDevice, over: threading.Event, counts: Counter[str]) -> None:
    """Send echoes, whistles and stops without a pause. Connect again when closed."""
    _flood_socket(pupil, over, counts, lambda: json.dumps({"t": "stop", "id": uuid.uuid4().hex}))


def _flood_socket(
    pupil: NetworkDevice, over: threading.Event, counts: Counter[str], more: Callable[[], str | None]
) -> None:
    texts = ('{"t":"echo","n":1,"press":1}', '{"t":"do","id":1,"verb":"whistle","cars":["red"]}')
    while not over.is_set():
        with contextlib.suppress(WebSocketException, OSError), pupil.socket() as page:
            counts["pages"] += 1
            while not over.is_set():
                for text in (*texts, more()):
                    if text is not None:
                        page.send(text)
                        counts["messages"] += 1


def flood_plans(pupil: NetworkDevice, over: threading.Event, counts: Counter[str]) -> None:
    """Have plans of 60 kB checked without a pause."""
    while not over.is_set():
        with contextlib.suppress(OSError, HTTPException):
            counts[f"plans {pupil.ask('POST', '/plan/check', PLAN)[0]}"] += 1


def flood_posts(pupil: NetworkDevice, over: threading.Event, counts: Counter[str]) -> None:
    """Have plans of 60 kB checked, and stop by POST, without a pause."""
    while not over.is_set():
        with contextlib.suppress(OSError, HTTPException):
            counts[f"plans {pupil.ask('POST', '/plan/check', PLAN)[0]}"] += 1
            counts[f"stops {pupil.ask('POST', '/stop')[0]}"] += 1


def flood_halves(pupil: NetworkDevice, over: threading.Event, counts: Counter[str]) -> None:
    """Open connections, and send half a request over each."""
    while not over.is_set():
        with contextlib.ExitStack() as kept:
            with contextlib.suppress(OSError):
                for _ in range(HALF_REQUESTS):
                    half_request(pupil, kept)
                    counts["half requests"] += 1
            over.wait(BETWEEN_HALVES_S)


def half_request(pupil: NetworkDevice, kept: contextlib.ExitStack) -> socket.socket:
    """Send a request with its cookie, and five bytes of its body. Return the connection."""
    raw = socket.create_connection(("127.0.0.1", pupil.port), timeout=5, source_address=pupil.source)
    kept.callback(raw.close)
    made = kept.enter_context(untrusting().wrap_socket(raw, server_hostname="127.0.0.1"))
    head = f"POST /plan/check HTTP/1.1\r\nHost: 127.0.0.1:{pupil.port}\r\nOrigin: {pupil.origin}\r\n"
    made.sendall(f"{head}Cookie: {pupil.cookie}\r\nContent-Length: 50000\r\n\r\nroles".encode())
    return made


FLOODS: Final = {
    "messages": flood_messages,
    "stops": flood_stops,
    "plans": flood_plans,
    "posts": flood_posts,
    "halves": flood_halves,
}


def start_flood(fleet: FleetProcesses, pupil: NetworkDevice, *kinds: str) -> GatewayProcess:
    """Start a process in which this paired device floods. Its `end` returns when it floods no more."""
    assert pupil.source is not None
    return fleet.start("-m", "tests.support.page_flood", str(pupil.port), pupil.source[0], pupil.cookie, *kinds)


def main() -> None:
    port, source, cookie, *kinds = sys.argv[1:]
    over, counts = threading.Event(), Counter[str]()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    pupil = NetworkDevice(int(port), source=source)
    pupil.cookie = cookie
    threads = [threading.Thread(target=FLOODS[kind], args=(pupil, over, counts), daemon=True) for kind in kinds]
    for thread in threads:
        thread.start()
    over.wait()
    for thread in threads:
        thread.join(5.0)
    print(json.dumps(counts))


if __name__ == "__main__":
    main()
