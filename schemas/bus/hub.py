"""The hub: a Zenoh router on loopback in its own process, which exits when it has no links.

The listening port is the mutex: a second hub on it fails at once. `bus.ensure_hub` starts it, or you by hand:
`python -m schemas.bus.hub --endpoint tcp/127.0.0.1:7447`.
"""

import argparse
import sys
import threading
import time
from typing import Final

import zenoh

from schemas.bus import DEFAULT_ENDPOINT, BusError, check_listening, router_config
from schemas.process import signals

IDLE_S: Final = 10.0
"""Time from the last link until the hub exits."""
_POLL_S: Final = 0.5


def serve(endpoint: str, idle_s: float, stop: threading.Event) -> None:
    """Route until `stop` is set or there was no link for `idle_s`. Raises zenoh.ZError if the port is in use."""
    with zenoh.open(router_config(endpoint)) as session:
        last_link = time.monotonic()
        while not stop.wait(_POLL_S):
            now = time.monotonic()
            if session.info.transports():
                last_link = now
            elif now - last_link > idle_s:
                return


def main() -> int:
    """Run a hub. Return 0 at its regular end, 1 if it could not listen, 2 for wrong use."""
    parser = argparse.ArgumentParser(prog="python -m schemas.bus.hub", description=__doc__)
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT)
    parser.add_argument("--idle-s", type=float, default=IDLE_S, help="end after so long without a link (default 10)")
    parser.add_argument(
        "--insecure-lan", action="store_true", help="listen on a network, where everyone may drive the cars"
    )
    arguments = parser.parse_args()
    try:
        check_listening(arguments.endpoint, insecure_lan=arguments.insecure_lan)
    except BusError as error:
        sys.stderr.write(f"hub: {error}\n")
        return 2
    stop = threading.Event()
    signals.calls(stop.set)
    try:
        serve(arguments.endpoint, arguments.idle_s, stop)
    except (zenoh.ZError, BusError) as error:
        sys.stderr.write(f"hub: cannot listen on {arguments.endpoint}: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
