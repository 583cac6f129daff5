"""Finds the hub that waits for somebody to join, by multicast DNS (zeroconf), so that its address need not be typed.

The hub is announced for as long as its invitation waits. Anybody in the network may announce anything, so the joining
computer trusts no announcement: it recognizes the right hub by the code (join_code.py). A false announcement can only
lead it to a hub that does not fit the code, and the number of hubs that are tried is limited.
"""

import socket
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

from zeroconf import IPVersion, ServiceBrowser, ServiceInfo, Zeroconf

from fleet.hub.join_code import JoinCode

JOIN_SERVICE: Final = "_car-fleet-hub._tcp.local."
SEARCH_S: Final = 3.0
"""Time to look for a hub. The last hub found may take a second more. Within this time, zeroconf asks twice: at once,
and after 1 s."""
MAX_FOUND_HUBS: Final = 16
"""Maximum number of hubs that are tried."""
_RESOLVE_MS: Final = 1000
_SEARCH_POLL_S: Final = 0.05


@contextmanager
def announced(port: int, code: JoinCode, addresses: Sequence[str]) -> Iterator[bool]:
    """Announce an invitation at this port while the block runs. Yield False if the network has no multicast."""
    info = ServiceInfo(
        JOIN_SERVICE,
        f"{_instance(code)}.{JOIN_SERVICE}",
        addresses=[socket.inet_aton(each) for each in addresses],
        port=port,
    )
    try:
        zeroconf = Zeroconf(interfaces=list(addresses), ip_version=IPVersion.V4Only)
    except OSError:
        yield False
        return
    try:
        zeroconf.register_service(info, allow_name_change=True)
        yield True
    finally:
        zeroconf.close()


def hubs_found(addresses: Iterable[str], timeout_s: float = SEARCH_S) -> Iterator[str]:
    """Yield host:port of hubs that wait for somebody, as they are found. `addresses` are those of this computer."""
    try:
        zeroconf = Zeroconf(interfaces=list(addresses), ip_version=IPVersion.V4Only)
    except OSError:
        return
    heard: deque[str] = deque(maxlen=MAX_FOUND_HUBS)
    seen: set[str] = set()
    try:
        ServiceBrowser(zeroconf, JOIN_SERVICE, handlers=[lambda **found: heard.append(str(found["name"]))])
        until = time.monotonic() + timeout_s
        while time.monotonic() < until and len(seen) < MAX_FOUND_HUBS:
            if not heard:
                time.sleep(_SEARCH_POLL_S)
                continue
            info = zeroconf.get_service_info(JOIN_SERVICE, heard.popleft(), _RESOLVE_MS)
            places = [] if info is None else [f"{each}:{info.port}" for each in info.parsed_addresses(IPVersion.V4Only)]
            for where in places:
                if where not in seen and len(seen) < MAX_FOUND_HUBS:
                    seen.add(where)
                    yield where
    finally:
        with suppress(OSError):
            zeroconf.close()


def _instance(code: JoinCode) -> str:
    """Return the name of an announcement: the beginning of the authority's fingerprint, which is not a secret."""
    return f"hub-{code.pin[:8].lower()}"
