"""Runs a gateway for one link for a moment, under a temporary name: a person sees its car blink, and names it."""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from fleet.client.client import Fleet
from fleet.supervisor.process_state import GATEWAY_GRACE_S
from schemas.process.children import OWN_GROUP, end
from schemas.process.parent import parent_option
from schemas.words import Motors

TEMPORARY_PREFIX: Final = "temporary-"
"""Prefix of the names of cars that exist only for a moment."""
_READY_S: Final = 15.0
"""Timeout for a gateway. It starts in 1 s, and brings a car of an unknown platform to a known state within 6 s."""
_READY_POLL_S: Final = 0.1


@contextlib.contextmanager
def temporary_gateway(client: Fleet, name: str, link: str, on_error: Callable[[str], object]) -> Iterator[str | None]:
    """Run a gateway for this link. Yield its car's name, or None if the gateway did not come up. No car moves."""
    name = f"{TEMPORARY_PREFIX}{name}"
    with tempfile.TemporaryDirectory() as directory, (Path(directory) / "log").open("w+", encoding="utf-8") as log:
        command = [sys.executable, "-m", "gateway.cli", "run", "--car", name, "--link", link, *parent_option()]
        command += ["--fleet", client.name, "--connect", client.bus.endpoint, "--state-dir", directory]
        gateway = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, process_group=OWN_GROUP)
        try:
            yield name if _is_ready(client, name, gateway, log.name, on_error) else None
        finally:
            end(gateway, GATEWAY_GRACE_S)


def _is_ready(
    client: Fleet, name: str, gateway: "subprocess.Popen[bytes]", log: str, on_error: Callable[[str], object]
) -> bool:
    """Wait until the gateway answers and its car stands still. Return True if it answers, even if the car is silent."""
    deadline, served = time.monotonic() + _READY_S, False
    while time.monotonic() < deadline:
        if gateway.poll() is not None:
            lines = Path(log).read_text(encoding="utf-8", errors="replace").strip().splitlines()
            on_error(lines[-1] if lines else "its gateway ended")
            return False
        states = client.get(f"{name}/state/safety")
        served = served or bool(states)
        if any(each.value.motors == Motors.OFF for each in states):
            return True
        time.sleep(_READY_POLL_S)
    if not served:
        on_error("its gateway did not come up")
    return served
