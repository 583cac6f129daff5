"""`fleet bind`: finds out which car is at which link. The car at each unknown link blinks, and a person names it.

For each link, a gateway runs for a moment under a temporary name. No car moves.
"""

from pathlib import Path
from typing import Final

import click

from fleet.client.client import Fleet
from fleet.commands.command_group import connect_option
from fleet.commands.exit_code import cli_errors
from fleet.commands.fleet_file import (
    confirm,
    file_argument,
    link_option,
    listen_option,
    look_for,
    print_errors,
    prompt_name,
    read,
    write,
)
from fleet.fleet_links import may_be_same, parse_fleet_link
from fleet.fleetfile.editor import CannotEdit, set_link
from fleet.fleetfile.fleet_file import FleetFile
from fleet.fleetfile.fleet_model import validate_link
from fleet.fleetfile.scan_process import FoundLink
from fleet.supervisor.temporary_gateway import temporary_gateway
from schemas.links import parse_link
from schemas.process import signals
from schemas.words import LinkVerdict
from schemas.yaml_document.document import BadFile, read_text

_AGAIN: Final = "again"
_NO_CAR: Final = "-"


@click.command(
    epilog="""\b
examples:
  fleet bind
  fleet bind lab.yaml --link /dev/ttyUSB0

A TCP car does not need this command: write its address into the file."""
)
@file_argument
@link_option
@listen_option
@connect_option("The bus (default: the file's, FLEET_ENDPOINT, the hub you joined, or port 7447 here).")
def bind(file: Path, links: tuple[str, ...], seconds: float | None, connect: str | None) -> None:
    """Find out which car is which: each car blinks and beeps, you type its name, and the file gets the car's link."""
    with cli_errors():
        for link in links:
            validate_link(link)
    fleet = read(file, unbound=True)
    found = [each for each in look_for(links, seconds) if each.verdict != LinkVerdict.BUSY and _is_unknown(each, fleet)]
    if not found:
        raise click.ClickException(
            f"No new car found. Links in {file}, ports in use and cars on TCP are left out. "
            "Is the new car switched on? `fleet scan` shows every link."
        )
    with (
        cli_errors(),
        signals.sigterm_interrupts(),
        Fleet(connect or fleet.endpoint, fleet.name, start_hub=True) as client,
    ):
        for number, each in enumerate(found, 1):
            click.echo(f"\n{number} of {len(found)}: {each.url}\n  {each.words}")
            with temporary_gateway(client, f"bind-{number}", each.url, _print_error) as name:
                if name is None:
                    continue
                car = _which(client, name, file)
            if car != _NO_CAR:
                _write(file, car, each.url)
    unbound = read(file, unbound=True).unbound
    if unbound:
        click.echo(f"still without a link: {', '.join(unbound)}")
    raise SystemExit(1 if unbound else 0)


def _is_unknown(found: FoundLink, fleet: FleetFile) -> bool:
    link = parse_link(found.url)
    if link.harm:
        return False
    return not any(may_be_same(link, parse_fleet_link(car.link)) for car in fleet.cars.values())


def _print_error(words: str) -> None:
    click.echo(f"  {words}", err=True)


def _which(client: Fleet, name: str, file: Path) -> str:
    """Make the car blink, and ask for its name. Return the name, or `-` if the user gives none."""
    while True:
        outcome = client.car(name).find()
        if not outcome.ok:
            click.echo(f"  the car could not blink: {outcome.words or outcome.reason or outcome.phase}", err=True)
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
            if not confirm(f"  {answer} has the link {there}. Replace it with this one?"):
                continue
        return answer


def _write(file: Path, car: str, link: str) -> None:
    """Write the link into the file. Read the file again first, because somebody may have edited it."""
    try:
        write(file, set_link(read_text(file), file, car, link))
    except BadFile as error:
        print_errors(error)
        raise SystemExit(1) from None
    except CannotEdit as error:
        raise click.ClickException(str(error)) from None
    click.echo(f"  {file}: {car} is at {link}")
