"""Endpoints, Zenoh configurations, and the start of a missing hub."""

import json
import os
import re
import socket
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import zenoh

from schemas.bus.errors import BadEndpoint, BusError, HubUnreachable
from schemas.state_dir import DEFAULT_ENDPOINT, joined_endpoint

if TYPE_CHECKING:
    from schemas.bus.credentials import Credentials

ENDPOINT_VARIABLE: Final = "FLEET_ENDPOINT"

_ENDPOINT: Final = re.compile(r"(?P<proto>tcp|tls|udp|quic|ws)/(?P<host>\[[^\]]+\]|[^:/\[\]]+):(?P<port>\d{1,5})")
_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2}
LOOPBACK: Final = "127.0.0.1"
LOOPBACK_TIMEOUT_S: Final = 1.0
NETWORK_TIMEOUT_S: Final = 3.5
"""Timeout for the answer of a listener. A TCP stack repeats the first packet of a connection after 1 s and after 3 s,
so two may be lost. On a network that lost 5 % each way, a timeout of 1 s was too short for 19 of 200 connections."""
NETWORK_OPEN_TIMEOUT_S: Final = 6.0
"""Time for one attempt to open a session over a network. A hub that is switched off never answers, so a person who
types a stop waits for this time. With 100 ms and 5 % loss each way, 200 attempts needed 0.8 to 4.0 s."""
_LOOPBACK_HOSTS: Final = re.compile(r"localhost|127\.\d+\.\d+\.\d+|\[::1\]")


def resolve_endpoint(argument: str | None = None) -> str:
    """Return the endpoint: the argument, FLEET_ENDPOINT, the joined hub, or loopback port 7447. Raises BadEndpoint."""
    if argument:
        _host_and_port(argument)
        return argument
    given = os.environ.get(ENDPOINT_VARIABLE)
    if not given:
        return joined_endpoint() or DEFAULT_ENDPOINT
    try:
        _host_and_port(given)
    except BadEndpoint as error:
        raise BadEndpoint(f"{ENDPOINT_VARIABLE}: {error}") from None
    return given


def _host_and_port(endpoint: str) -> tuple[str, int]:
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise BadEndpoint(
            f"endpoint {endpoint!r} is not allowed: write it as tcp/HOST:PORT (tls, udp, quic or ws also), "
            f"port 1 to 65535, for example {DEFAULT_ENDPOINT}"
        )
    return match["host"], int(match["port"])


def is_loopback(endpoint: str) -> bool:
    """Return True if no other machine can reach the endpoint. Raises BadEndpoint."""
    host, _ = _host_and_port(endpoint)
    return _LOOPBACK_HOSTS.fullmatch(host) is not None


def check_listening(endpoint: str, *, insecure_lan: bool) -> None:
    """Raise BadEndpoint if a hub would be open to a network without the user's consent."""
    # A plain hub has no passwords and no certificates: everyone who reaches it can drive the cars.
    if not insecure_lan and not is_loopback(endpoint) and not is_secure(endpoint):
        raise BadEndpoint(
            f"a hub at {endpoint} would let everyone on that network drive the cars: "
            f"use {DEFAULT_ENDPOINT}, start a Zenoh router of your own there, or accept it with --insecure-lan"
        )


# The cost of each default that this replaces is in docs/explanation/measurements.md#one-hub; the reason for the
# lease is in docs/explanation/measurements.md#cut-links.
def _common(link: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": 2000}, **link}},
    }


def is_secure(endpoint: str) -> bool:
    """Return True if links to the endpoint need certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def router_settings(endpoint: str) -> dict[str, Any]:
    """Return the settings of the hub in Zenoh's form. Raises BadEndpoint, BusError."""
    _host_and_port(endpoint)
    listen: dict[str, Any] = {"endpoints": [endpoint], "exit_on_failure": True, "timeout_ms": 0}
    if not is_secure(endpoint):
        return {"mode": "router", "listen": listen, **_common({})}
    credentials = credentials_of(endpoint)
    listen["endpoints"] = credentials.listens or [endpoint]
    own = {"mode": "router", "listen": listen, "access_control": credentials.access_control}
    if first := credentials.first_hubs:
        own["connect"] = {"endpoints": first, "timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY}
    return {**own, **_common(credentials.of_hub())}


def router_config(endpoint: str) -> zenoh.Config:
    """Return the configuration of the hub. Raises BadEndpoint, BusError."""
    return zenoh.Config.from_json5(json.dumps(router_settings(endpoint)))


def client_config(endpoint: str, timeout_s: float, identity: str = "") -> zenoh.Config:
    """Return the configuration of a client of the hub, which retries for `timeout_s`. Raises BusError."""
    connect = {
        "endpoints": [endpoint],
        "timeout_ms": int(timeout_s * 1000),
        "exit_on_failure": True,
        "retry": _RETRY,
    }
    link = credentials_of(endpoint).of_client(identity) if is_secure(endpoint) else {}
    settings: dict[str, Any] = {"mode": "client", "connect": connect, **_common(link)}
    if not is_loopback(endpoint):
        settings["transport"]["unicast"] = {"open_timeout": int(NETWORK_OPEN_TIMEOUT_S * 1000)}
    return zenoh.Config.from_json5(json.dumps(settings))


def credentials_of(endpoint: str) -> "Credentials":
    """Return the files for a hub with certificates, which may not exist."""
    from schemas.bus.credentials import Credentials  # here, because the import delays a gateway, and most need none

    return Credentials.of(endpoint)


def accepts(endpoint: str) -> bool:
    """Return True if something accepts connections at the endpoint. Always True for a datagram endpoint."""
    host, port = _host_and_port(endpoint)
    timeout_s = LOOPBACK_TIMEOUT_S if is_loopback(endpoint) else NETWORK_TIMEOUT_S
    if endpoint.startswith(("udp/", "quic/")):
        return True
    try:
        with socket.create_connection((host.strip("[]"), port), timeout=timeout_s):
            return True
    except OSError:
        return False


def unreachable(endpoint: str) -> HubUnreachable:
    """Return the error of a hub on another computer that does not answer. A hub is started only on loopback."""
    return HubUnreachable(
        f"Nothing answers at {endpoint}. Is that computer on and in reach, and does its hub run? Give another address "
        "with --connect.",
        endpoint,
    )


def ensure_hub(endpoint: str, timeout_s: float = 30.0) -> None:
    """Start a hub if nothing accepts connections at a loopback endpoint, and wait until it listens. Raises BusError.

    A hub at a datagram endpoint (udp, quic) is never started here, because `accepts` cannot see that it is missing.
    """
    # The hub runs in a session of its own and outlives the process that started it. So Ctrl-C at a terminal does not
    # end the bus before the cars have stopped. The hub exits 10 s after its last link has closed. On a busy machine its
    # start takes 10 s.
    if accepts(endpoint):
        return
    if not is_loopback(endpoint):
        raise unreachable(endpoint)
    from schemas.process.children import leave, start_detached, wait

    hub = start_detached([sys.executable, "-m", "schemas.bus.hub", "--endpoint", endpoint])
    deadline = time.monotonic() + timeout_s
    while not accepts(endpoint):
        if time.monotonic() > deadline:
            raise BusError(f"No hub came up at {endpoint} within {timeout_s:g} s. Does another program use the port?")
        # If two hubs start at once, one of them cannot listen and ends. The other one listens in a moment.
        if wait(hub, 0.02) is not None:
            time.sleep(0.02)
    leave(hub)
