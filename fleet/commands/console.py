"""`fleet console`: a web page that shows the fleet, drives cars and stops them."""

import asyncio
import http.client
import json
import os
import signal
import socket
import sys
import time
import webbrowser
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fleet.aio import Fleet
from fleet.client.client import default_sender
from fleet.commands.command_group import (
    DefaultCommandGroup,
    chosen_person,
    connect_option,
    fleet_option,
    say,
    starter_option,
)
from fleet.commands.exit_code import cli_errors
from fleet.commands.options import bus_options, json_option
from fleet.commands.output import show_table
from fleet.commands.params import Number
from fleet.console import DEFAULT_PORT
from fleet.console.people_book import RANKS, PagePerson, UnknownPerson
from fleet.console.people_file import PeopleFile, people_path
from fleet.console.server import HELLO, listen, serve
from fleet.fleetfile.fleet_file import people_table, read_people
from fleet.recording.session_lookup import sessions_place
from schemas import keys
from schemas.bus import LOOPBACK, resolve_endpoint
from schemas.identity import Service, service
from schemas.process.parent import has_ended, watched_pid
from schemas.rights import People
from schemas.words import Rank

if TYPE_CHECKING:
    from fleet.console.network_console import Lan

DEFAULT_LAN_PORT: Final = 7443
HEARTBEAT_INTERVAL_S: Final = 1.0
_PROBE_TIMEOUT_S: Final = 1.0


def _check_host(_: click.Context, __: click.Parameter, host: str) -> str:
    """Refuse every other address than the one of the page."""
    if host not in (LOOPBACK, "localhost"):
        raise click.UsageError(
            f"Without a pairing the console serves this computer only, at {LOOPBACK}, not {host}. "
            "For phones and other computers, type: fleet console --lan"
        )
    return host


def listen_or_fail(port: int | None, other: str) -> socket.socket:
    """Return a socket that listens at this port, or at the default port if `port` is None. Raises ClickException.

    other: a command that the error proposes. Another port replaces `{other}` in it.
    """
    port = DEFAULT_PORT if port is None else port
    try:
        return listen(port)
    except OSError as error:
        command = other.format(other=port + 1 if port < 65535 else port - 1)
        raise click.ClickException(f"{_port_in_use(port, error)} `{command}` uses another port.") from None


async def _send_heartbeats(parent: int, address: str) -> None:
    """Print the address each second for `fleet up`. When `fleet up` ends, end this process, too."""
    with suppress(OSError):  # nobody reads any more
        while not has_ended(parent):
            click.echo(json.dumps({"console": address}))
            await asyncio.sleep(HEARTBEAT_INTERVAL_S)
    os.kill(os.getpid(), signal.SIGTERM)


@click.group(
    cls=DefaultCommandGroup,
    default_command="serve",
    subcommand_metavar="[COMMAND | OPTIONS]",
    epilog="\b\nexamples:\n  fleet console --open\n  fleet console --as teacher --lan\n  fleet console pair group_a",
)
def console() -> None:
    """Serve the fleet as a web page: watch, drive, STOP. Without a subcommand: `fleet console serve`."""


@console.command(
    "serve",
    epilog="""\b
examples:
  fleet console serve
  fleet console --open
  fleet console --lan""",
)
@click.option(
    "--port",
    type=Number(int, 0, 65535),
    default=DEFAULT_PORT,
    show_default=True,
    help="Serve at this port. With 0, at any free port.",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default=LOOPBACK,
    show_default=True,
    callback=_check_host,
    expose_value=False,
    help="Any other address is refused: the page is for this computer only, except with --lan.",
)
@click.option("--lan", "on_lan", is_flag=True, help="Also serve paired devices on the network, over HTTPS.")
@click.option(
    "--lan-port",
    type=Number(int, 0, 65535),
    default=DEFAULT_LAN_PORT,
    show_default=True,
    help="Serve the network at this port. With 0, at any free port.",
)
@click.option(
    "--sessions",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Show the sessions in DIR (default: as in the fleet file here, or sessions).",
)
@click.option(
    "--fleet-file",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("fleet.yaml"),
    show_default=True,
    help='File into which the page "Set up" writes links.',
)
@starter_option()
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@bus_options
def serve_console(
    *,
    starter: int | None,
    port: int,
    opens: bool,
    on_lan: bool,
    lan_port: int,
    sessions: Path | None,
    fleet_file: Path,
    connect: str | None,
    fleet: str,
) -> None:
    """Serve the page on this computer, until Ctrl-C. On every page, the Escape key is STOP."""
    parent = watched_pid(starter)
    listener = listen_or_fail(port, "fleet console --port 0")
    address = f"http://{LOOPBACK}:{listener.getsockname()[1]}"

    with listener:
        file = PeopleFile(people_path(resolve_endpoint(connect), fleet))
        lan = _open_lan(lan_port, file, _people_of(fleet_file)) if on_lan else None

        def on_ready() -> None:
            if parent is None:
                click.echo(f"Console: {address} (Ctrl-C ends it)")
            if lan is not None:
                _describe_lan(lan)
            if opens:
                webbrowser.open(address)

        async def run() -> Any:
            async with Fleet(
                connect, fleet, kind=Rank.PERSON, person=chosen_person(), identity=service(Service.CONSOLE)
            ) as client:
                heartbeats = None if parent is None else asyncio.ensure_future(_send_heartbeats(parent, address))
                await serve(client, listener, on_ready, sessions or sessions_place(), fleet_file, lan)
                if heartbeats is not None:
                    heartbeats.cancel()

        try:
            asyncio.run(run())
        finally:
            if lan is not None:
                lan.listener.close()


@console.command(
    epilog="""\b
examples:
  fleet console pair
  fleet console pair group_a
  fleet console pair teacher --rank lead""",
)
@click.argument("name", required=False)
@click.option(
    "--rank",
    type=click.Choice(RANKS),
    default=RANKS[0],
    show_default=True,
    metavar="RANK",
    help="Rank of the person: person or lead.",
)
@connect_option()
@fleet_option()
def pair(name: str | None, rank: str, connect: str | None, fleet: str) -> None:
    """Make a code that pairs one device with the console as the person NAME (default: you).

    If the fleet file lists people, NAME must be one of them, and may be a lead only if the file says so. A console that
    serves the network must be running: `fleet console --lan`.
    """
    person = PagePerson(name or _own_name(), rank)
    with cli_errors():
        people = PeopleFile(people_path(resolve_endpoint(connect), fleet))
        if not people.is_served:  # nobody serves the page to which the code would lead
            raise click.UsageError("No console serves the network now. `fleet console --lan` starts one.")
        try:
            _show_code(people, people.read().address, person)
        except ValueError as error:
            raise click.UsageError(str(error)) from None


@console.command(
    epilog="""\b
examples:
  fleet console people
  fleet console people --revoke group_a""",
)
@click.option(
    "--revoke", metavar="NAME", multiple=True, help="Revoke all devices of a person, or one device by its id."
)
@json_option
@connect_option()
@fleet_option()
def people(revoke: tuple[str, ...], *, as_json: bool, connect: str | None, fleet: str) -> None:
    """List the devices that are paired with the console, or revoke some."""
    with cli_errors():
        file = PeopleFile(people_path(resolve_endpoint(connect), fleet))
        if revoke:
            _revoke(file, revoke)
            return
    devices = file.read().open_devices(time.time())
    rows = [
        {
            "id": each.id,
            "name": each.person.name,
            "rank": each.person.rank,
            "expires": f"{datetime.fromtimestamp(each.expires_s, UTC):%Y-%m-%d}",
            "device": each.device,
        }
        for each in devices
    ]
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
    elif rows:
        show_table(tuple(rows[0]), rows)
    else:
        click.echo("No device is paired. `fleet console pair NAME` makes a code.", err=True)


def _revoke(file: PeopleFile, names: tuple[str, ...]) -> None:
    book = file.read()
    known = {word for each in book.devices for word in (each.id, each.person.name)}
    coded = {each.person.name for each in book.codes if each.is_open(time.time())}
    if missing := [name for name in names if name not in known | coded]:
        raise click.UsageError(
            f"No paired device has the id or person {missing[0]!r}. `fleet console people` lists them."
        )
    try:
        revoked = file.change(lambda book: book.revoke(names))
    except OSError as error:
        raise _not_written(file, error) from None
    for each in revoked:
        click.echo(f"{each.id} ({each.person.name}) is revoked. Its pages are closed.")
    for name in sorted(coded.intersection(names)):
        click.echo(f"The open code of {name} is revoked.")


def _people_of(file: Path) -> People:
    """Return the people in a fleet file. Nobody if the file cannot be read."""
    return people_table(read_people(file))


def _open_lan(port: int, people: PeopleFile, listed: People) -> "Lan":
    from fleet.console import network_console  # importing it takes 0.1 s; only --lan needs it

    try:
        listener = network_console.LimitedListener.on_port(port)
    except OSError as error:
        raise click.ClickException(
            f"Port {port} is not free ({error.strerror}). `fleet console --lan --lan-port 0` uses a free one."
        ) from None
    try:
        lan = network_console.Lan(listener, people, listed)
    except OSError as error:
        listener.close()
        raise click.ClickException(
            f"The console cannot serve the network: {error.filename}: {error.strerror}"
        ) from None
    return lan


def _describe_lan(lan: "Lan") -> None:
    click.echo(f"On the network: {lan.address}")
    click.echo(f"Certificate SHA-256: {lan.certificate.fingerprint}")
    try:
        _show_code(lan.people, lan.address, PagePerson(_own_name()))
    except UnknownPerson as error:
        say(f"To pair a device, type: fleet console pair NAME. {error}")


def _show_code(people: PeopleFile, address: str, person: PagePerson) -> None:
    from fleet.console import pairing  # importing it takes 0.1 s; only --lan and `pair` need it

    try:
        code = pairing.issue_code(people, person)
    except OSError as error:
        raise _not_written(people, error) from None
    pairing.show_code(address, code, person, click.echo, draws=sys.stdout.isatty())


def _not_written(people: PeopleFile, error: OSError) -> click.ClickException:
    return click.ClickException(f"{people.path} cannot be written: {error.strerror}")


def _own_name() -> str:
    name = keys.person_of(default_sender(chosen_person())).lower()
    return name if keys.is_name(name) else "me"


def _port_in_use(port: int, error: OSError) -> str:
    """Return a text about the program that uses a port of loopback."""
    probe = http.client.HTTPConnection(LOOPBACK, port, timeout=_PROBE_TIMEOUT_S)
    try:
        probe.request("GET", "/hello")
        if probe.getresponse().read(len(HELLO)) == HELLO.encode():
            return f"Another console is at http://{LOOPBACK}:{port}."
    except (OSError, http.client.HTTPException):
        pass
    finally:
        probe.close()
    return f"Port {port} is not free ({error.strerror})."
