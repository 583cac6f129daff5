"""`fleet bind`: finds out which car is at which link. The car at each unknown link blinks, and a person names it.

For each link, a gateway runs for a moment under a temporary name. No car moves.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click

from fleet.client.client import Fleet
from fleet.commands.fleet_file import (
    file_argument,
    link_option,
    listen_option,
    look_for,
    print_errors,
    prompt_name,
    read,
    write,
)
from fleet.commands.group import connect_option
from fleet.commands.options import cli_errors
from fleet.fleetfile.editor import CannotEdit, set_link
from fleet.fleetfile.fleet_file import FleetFile
from fleet.fleetfile.models import validate_link
from fleet.fleetfile.scan import FoundLink
from fleet.links import may_be_same, parse_fleet_link
from fleet.supervisor.restart_policy import GATEWAY_GRACE_S
from schemas.links import TcpUrl
from schemas.process import signals
from schemas.yaml_document.document import BadFile, read_text

_READY_S: Final = 15.0
"""Timeout for a gateway. It starts in 1 s, and brings a car of an unknown platform to a known state within 6 s."""
_READY_POLL_S: Final = 0.1
_AGAIN: Final = "again"
_NO_CAR: Final = "-"


@click.command(
    epilog="""\b
examples:
  fleet bind
  fleet bind lab.yaml --link /dev/ttyUSB0

A TCP car is named by its address: write that into the file."""
)
@file_argument
@link_option
@listen_option
@connect_option("The bus (default: the file's, FLEET_ENDPOINT, or port 7447).")
def bind(file: Path, links: tuple[str, ...], seconds: float | None, connect: str | None) -> None:
    """Find out which car is which: each blinks and beeps, you type its name, and the file gets its link."""
    with cli_errors():
        for link in links:
            validate_link(link)
    fleet = read(file, unbound=True)
    found = [each for each in look_for(links, seconds) if each.verdict != "busy" and _unknown(each, fleet)]
    if not found:
        raise click.ClickException(
            f"No new car found: all that answered are in {file} already. Is it switched on? "
            "`fleet scan` shows what was seen."
        )
    with (
        cli_errors(),
        signals.sigterm_interrupts(),
        Fleet(connect or fleet.endpoint, fleet.name, start_hub=True) as client,
    ):
        for number, each in enumerate(found, 1):
            click.echo(f"\n{number} of {len(found)}: {each.url}\n  {each.words}")
            with _gateway(client, f"bind-{number}", each.url) as name:
                if name is None:
                    continue
                car = _which(client, name, file)
            if car != _NO_CAR:
                _write(file, car, each.url)
    left = read(file, unbound=True).unbound
    if left:
        click.echo(f"still without a link: {', '.join(left)}")
    raise SystemExit(1 if left else 0)


def _unknown(found: FoundLink, fleet: FleetFile) -> bool:
    link = parse_fleet_link(found.url)
    if isinstance(link, TcpUrl):
        return False
    return not any(may_be_same(link, parse_fleet_link(car.link)) for car in fleet.cars.values())


@contextlib.contextmanager
def _gateway(client: Fleet, name: str, link: str) -> Iterator[str | None]:
    """Run a gateway for this link. Yield its car's name, or None if the gateway did not come up."""
    with tempfile.TemporaryDirectory() as directory, (Path(directory) / "log").open("w+", encoding="utf-8") as log:
        command = [sys.executable, "-m", "gateway.cli", "run", "--car", name, "--link", link, "--with-parent"]
        command += ["--fleet", client.name, "--connect", client.bus.endpoint, "--state-dir", directory]
        # In its own session, so that Ctrl-C at the terminal reaches only us. We let the gateway stop its car.
        gateway = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        try:
            yield name if _ready(client, name, gateway, log.name) else None
        finally:
            gateway.terminate()
            try:
                gateway.wait(GATEWAY_GRACE_S)
            except subprocess.TimeoutExpired:
                gateway.kill()
                gateway.wait()


def _ready(client: Fleet, name: str, gateway: "subprocess.Popen[bytes]", log: str) -> bool:
    """Wait until the gateway serves and its car stands. Return True if it serves, also for a silent car."""
    deadline, served = time.monotonic() + _READY_S, False
    while time.monotonic() < deadline:
        if gateway.poll() is not None:
            lines = Path(log).read_text(encoding="utf-8", errors="replace").strip().splitlines()
            click.echo(f"  {lines[-1] if lines else 'its gateway ended'}", err=True)
            return False
        states = client.get(f"{name}/state/safety")
        served = served or bool(states)
        if any(each.value.motors == "off" for each in states):
            return True
        time.sleep(_READY_POLL_S)
    if not served:
        click.echo("  its gateway did not come up", err=True)
    return served


def _which(client: Fleet, name: str, file: Path) -> str:
    """Let the car blink until the user names it. Return the name, or `-` for none."""
    while True:
        outcome = client.car(name).find()
        if not outcome.ok:
            click.echo(f"  it could not blink: {outcome.words or outcome.reason or outcome.phase}", err=True)
            return _NO_CAR
        fleet = read(file, unbound=True)
        listed = ", ".join([*fleet.unbound, *(car for car in fleet.cars if car not in fleet.unbound)])
        first = fleet.unbound[0] if len(fleet.unbound) == 1 else None
        words = f"  Which car blinked? ({listed}, a new name, {_AGAIN}, {_NO_CAR} for none)"
        answer = prompt_name(words, first, set())
        if answer == _AGAIN:
            continue
        if answer in fleet.cars:
            there = fleet.cars[answer].link
            if not click.confirm(f"  {answer} has the link {there}. Give it this one?"):
                continue
        return answer


def _write(file: Path, car: str, link: str) -> None:
    """Write the link into the file as it is now."""
    try:
        write(file, set_link(read_text(file), file, car, link))
    except BadFile as error:
        print_errors(error)
        raise SystemExit(1) from None
    except CannotEdit as error:
        raise click.ClickException(str(error)) from None
    click.echo(f"  {file}: {car} is at {link}")
