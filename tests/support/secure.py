"""A fleet of real processes on a hub with certificates. Every identity has its certificate in the same directory."""

import contextlib
import json
import os
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet.hub.hub_store import HubStore
from schemas import keys, messages
from schemas.bus import accepts, router_settings
from schemas.bus.credentials import Credentials
from schemas.commands import COMMANDS
from schemas.identity import Service, service
from schemas.state_dir import STATE_VARIABLE, directory_of
from tests.support.ports import free_port
from tests.support.processes import FleetProcesses, wait_for


@contextlib.contextmanager
def secure_fleet(
    directory: Path, me: str, others: Iterable[str], router: Path | None = None
) -> Iterator[tuple[FleetProcesses, HubStore]]:
    """Run a hub with certificates for `me`, the others and all services. Programs find them by FLEET_STATE_DIR.

    router: a stock Zenoh router to run in its place.
    """
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(STATE_VARIABLE, str(directory / "state"))
        patch.delenv("FLEET_AS", raising=False)
        store = HubStore.of(endpoint)
        store.ensure([*others, *map(service, Service)], me, addresses=["127.0.0.1"])
        assert store.directory.is_relative_to(directory_of(endpoint, directory / "state"))
        with contextlib.ExitStack() as stack:
            if router is not None:  # our own hub ends at once, since the port is taken
                file = directory / "router.json5"
                file.write_text(json.dumps(router_settings(endpoint)))
                process = stack.enter_context(subprocess.Popen([router, "--config", file], stderr=subprocess.DEVNULL))
                stack.callback(process.kill)
                wait_for(lambda: accepts(endpoint), "the router listens")
            yield stack.enter_context(contextlib.closing(FleetProcesses(endpoint, directory))), store


@contextlib.contextmanager
def stranger(credentials: Credentials, **tls: Any) -> Iterator[zenoh.Session]:
    """Open a plain Zenoh client, as anybody could write it, with these settings of TLS. Raises zenoh.ZError."""
    with zenoh.open(zenoh.Config.from_json5(json.dumps(plain_settings(credentials.endpoint, tls)))) as session:
        yield session


def plain_settings(endpoint: str, tls: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a plain Zenoh client."""
    return {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 2000, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}, "link": {"protocols": ["tls"], "tls": tls}},
    }


@contextlib.contextmanager
def client_of(credentials: Credentials, identity: str) -> Iterator[zenoh.Session]:
    """Open a plain Zenoh client with the certificate of an identity."""
    with stranger(credentials, **credentials.of_client(identity)["tls"]) as session:
        yield session


def ask(session: zenoh.Session, key: str, timeout_s: float = 5.0, **fields: Any) -> list[dict[str, Any]]:
    """Send a command in JSON to a key. Return the answers. For an error, the answer has only the words."""
    replies = session.get(
        key,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
        payload=json.dumps(fields).encode(),
        encoding=messages.JSON,
    )
    found: list[dict[str, Any]] = []
    for reply in replies:
        if reply.ok is not None:
            found.append(json.loads(reply.ok.payload.to_bytes()))
        elif reply.err is not None:
            found.append({"words": reply.err.payload.to_string()})
    return found


FIELDS: dict[str, dict[str, Any]] = {
    "drive": {"motion": "forward", "duration_s": 0.2},
    "mode": {"mode": "manual"},
    "led": {"r": 1, "g": 2, "b": 3},
    "light": {"light": "off"},
    "servo": {"servo": "front", "deg": 90},
    "arm": {"joint_deg": [90] * 6},
    "speed": {"step": "up"},
    "fan": {"state": "off"},
    "lend": {"to": "mia", "duration_s": 1.0},
}
"""Fields of each verb that needs some."""
assert set(FIELDS) <= set(COMMANDS)
PID = os.getpid()


def sender_of(identity: str) -> str:
    """Return the sender whose name an identity may use."""
    return f"{identity.partition('.')[2]}@test-{PID}"


def shapes(target: str, verb: str, own: str, others: Iterable[str]) -> dict[str, str]:
    """Return every key by which somebody could try to send a command, by name. `own` is allowed."""
    found = {"own": keys.command_key("fleet", target, verb, own), "plain": keys.command_key("fleet", target, verb)}
    found |= {f"as {other}": keys.command_key("fleet", target, verb, other) for other in others if other != own}
    return found | {
        "as anyone": keys.command_key("fleet", target, verb, "*"),
        "by verb": keys.command_key("fleet", target, "*", "*"),
        "everything": f"fleet/{target}/@cmd/**",
        "everyone": f"fleet/{target}/@cmd/@by/**",
    }
