"""`fleet hub`, `fleet join`, `fleet leave`: a bus with certificates and rules, on one computer or on several."""

import json
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import click
import segno

from fleet.client.client import Fleet
from fleet.commands.command_group import CommandGroup
from fleet.commands.exit_code import cli_errors
from fleet.commands.options import json_option
from fleet.commands.output import show_table
from fleet.commands.params import Number
from fleet.hub import local_hub
from fleet.hub.addresses import own_addresses, own_names
from fleet.hub.discovery import announced, hubs_found
from fleet.hub.hub_store import HubStore, KnownIdentity
from fleet.hub.invitation import Invitation
from fleet.hub.join import JOIN_PORT, join, join_one_of
from fleet.hub.join_code import JOIN_CODE_LIFETIME_S, JoinCode
from schemas import identity, keys
from schemas.bus import (
    ENDPOINT_VARIABLE,
    LOOPBACK,
    Bus,
    BusError,
    is_loopback,
    is_secure,
    resolve_endpoint,
    router_settings,
)
from schemas.bus.credentials import Credentials
from schemas.bus.hub_links import LINKS_FILE
from schemas.identity import IdentityRole, Service
from schemas.printable import printable
from schemas.running_cars import running_cars
from schemas.state_dir import joined_endpoint
from schemas.words import Rank

DEFAULT_FLEET_FILE: Final = Path("fleet.yaml")
MAX_JOIN_LINE: Final = 500
"""Maximum characters of the line that `fleet join -` reads."""
TRY_INTERVAL_S: Final = 0.1
"""Interval at which a hub that may be restarting is tried again."""
HUB_RESTART_S: Final = 2.0
"""Time within which gateways are connected again after new rules. The hub looks for new rules every 0.5 s, and gateways
try to connect every 0.5 s."""
SITE_RULES_S: Final = 5.0
"""The same time at another site, whose hub asks the main hub for new rules every two seconds."""


@click.group(
    cls=CommandGroup,
    epilog="""\b
examples:
  fleet hub init
  fleet hub invite mia
  fleet hub invite --car red
  fleet hub show
""",
)
def hub() -> None:
    """Make this computer the hub of several computers. Certificates prove the identity of everybody."""


@hub.command(epilog="\b\nexamples:\n  fleet hub init\n  fleet hub init --car red")
@click.option(
    "--car", "cars", multiple=True, metavar="CAR", help="Also make a certificate for this car, whose gateway runs here."
)
@click.option(
    "--service",
    "services",
    multiple=True,
    type=click.Choice([each.value for each in Service]),
    help="Run this service here again, although another computer was invited to run it.",
)
@click.option("--local", is_flag=True, help="Listen on loopback only, as `fleet up --secure` does.")
def init(cars: tuple[str, ...], services: tuple[str, ...], *, local: bool) -> None:
    """Make this computer the hub that other computers may join.

    The hub gets its own certificate authority, and a certificate for you and for each service. `fleet up` starts the
    hub, and adds the certificates of its cars. The hub listens on the network, with TLS, and refuses everybody without
    a certificate. On one computer alone, `fleet up --secure` does the same, but the hub listens only on loopback.
    """
    with cli_errors(), _disk_errors():
        take = [*map(identity.car, map(keys.check_name, cars)), *map(identity.service, map(Service, services))]
        endpoint = resolve_endpoint()
        endpoint = endpoint if is_secure(endpoint) else local_hub.SECURE_ENDPOINT
        listens = endpoint if local else local_hub.everywhere(endpoint)
        store = local_hub.ensure_hub_here(endpoint, take=take, listens=(listens,))
    name = store.credentials.me.partition(".")[2]
    click.echo(
        f"This computer is a hub now, and you are {name} there. Its certificate authority is in {store.directory}: "
        "keep a copy of ca.key and ca.pem in a safe place.\n`fleet up` starts it. `fleet hub invite NAME` lets "
        "the computer of a person join, and `fleet hub invite --car NAME` a computer with a car."
    )
    _say_of_other_bus(endpoint)


@hub.command(
    epilog="""\b
examples:
  fleet hub invite mia
  fleet hub invite --car red
  fleet hub invite --car red --qr
  fleet hub invite --site north
  fleet hub invite --service recorder --site north"""
)
@click.argument("person", required=False)
@click.option("--car", metavar="CAR", help="Invite a computer that runs the gateway of this car.")
@click.option(
    "--service", type=click.Choice([each.value for each in Service]), help="Invite a computer that runs this service."
)
@click.option(
    "--site",
    metavar="SITE",
    help="Invite the computer that is the hub of another site. With --service, invite a service there.",
)
@click.option(
    "--port",
    type=Number(int, 1, 65535),
    default=JOIN_PORT,
    help=f"Port on which this command waits for the joining computer (default: {JOIN_PORT}).",
)
@click.option("--as-hub", "host", metavar="HOST", help="Call this computer HOST in the command that is printed.")
@click.option("--qr", is_flag=True, help="Also draw the command as a QR code, for a camera and `fleet join -`.")
@json_option
def invite(
    person: str | None,
    car: str | None,
    service: str | None,
    site: str | None,
    port: int,
    host: str | None,
    *,
    qr: bool,
    as_json: bool,
) -> None:
    """Let one other computer join, once, within ten minutes. Print the command to type there, and wait.

    First the hub restarts, to load one more rule. Everybody is connected again after a second. Drives may end
    meanwhile; modes continue.
    """
    if [person, car, service, None if service else site].count(None) != 3:
        raise click.UsageError(
            "say who is invited: fleet hub invite NAME, or --car NAME, or --service NAME, or --site NAME"
        )
    with cli_errors(), _disk_errors():
        what = "car name" if car else "site" if site else "person"
        name = keys.check_name(person or car or site or service or "", what)
        if service:
            invited = identity.service(Service(service), site or "")
            name = f"{service} of {site}" if site else service
        else:
            invited = identity.car(name) if car else identity.site(name) if site else identity.person(name)
        endpoint = resolve_endpoint()
        store = _own_store(endpoint)
        addresses = own_addresses() or [LOOPBACK]
        here = host or addresses[0]
        if here != LOOPBACK and all(map(is_loopback, store.credentials.listens or [endpoint])):
            raise click.ClickException("This hub listens on loopback only: `fleet hub init` opens it to the network.")
        store = local_hub.ensure_hub_here(endpoint)  # the addresses of this computer may have changed
        text = DEFAULT_FLEET_FILE.read_text(encoding="utf-8") if DEFAULT_FLEET_FILE.is_file() else ""
        hub_port = int(endpoint.rpartition(":")[2])
        invitation = Invitation(store, invited, hub_port=hub_port, port=port, fleet_file=text)
    try:
        if car and invited in store.known:
            _stop_first(endpoint, car)
        with cli_errors(), _disk_errors():
            store.reserve(invited)  # do this last, once we listen: it ends an earlier certificate
        if port != JOIN_PORT:
            here = f"{here}:{port}"
        if as_json:
            click.echo(json.dumps({"identity": invited, "host": here, "code": str(invitation.code)}))
        else:
            line = f"fleet join {here} {invitation.code}"
            click.echo(f"On the other computer, within ten minutes:\n  {line}")
            click.echo(f"In this network `fleet join {invitation.code}` finds this hub, too.")
            if qr:
                segno.make(line).terminal(sys.stdout, compact=True, border=2)
        with announced(invitation.port, invitation.code, addresses):
            why = invitation.wait(JOIN_CODE_LIFETIME_S)
    finally:
        invitation.close()
    if why:
        raise click.ClickException(f"{name}: {why}")
    click.echo(f"{name} has joined from {invitation.joined_from}")


@hub.command(epilog="\b\nexamples:\n  fleet hub show\n  fleet hub show --json")
@json_option
def show(*, as_json: bool) -> None:
    """Show who may connect, who is connected now and from where, and when the certificates expire."""
    with cli_errors():
        store = _own_store(resolve_endpoint())
    links = _links(store)
    rows = [_row(name, each, links) for name, each in sorted(store.known.items())]
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    show_table(("identity", "state", "from", "until"), rows)


@hub.command(epilog="\b\nexample:\n  fleet hub config > zenohd.json5 && zenohd -c zenohd.json5")
def config() -> None:
    """Print the configuration of a stock Zenoh router that replaces this hub, with its certificates and rules.

    Print it again and restart the router after each `fleet hub invite` and `revoke`, and after a new car.
    """
    with cli_errors():
        endpoint = resolve_endpoint()
        _own_store(endpoint)
        click.echo(json.dumps(router_settings(endpoint), indent=1))


@hub.command(epilog="\b\nexamples:\n  fleet hub revoke person.mia\n  fleet hub revoke car.red")
@click.argument("who", metavar="IDENTITY")
def revoke(who: str) -> None:
    """Deny everything to an identity from now on. The hub restarts.

    Everybody else is connected again after a second.
    """
    with cli_errors(), _disk_errors():
        store = _own_store(resolve_endpoint())
        if who == store.credentials.me:
            raise click.UsageError(f"{who} is you, on the hub's own computer: nobody could undo this")
        role, name = identity.parse(who) or (None, "")
        if role is IdentityRole.CAR and who in store.known:
            _stop_first(store.credentials.endpoint, name)
        if not store.revoke(who):
            there = ", ".join(name for name, each in sorted(store.known.items()) if not each.revoked)
            raise click.UsageError(f"{printable(who)} has no certificate. There are: {there}")
    words = (
        " Cars that this person drove may still move: stop them with `fleet stop`."
        if role is IdentityRole.PERSON
        else ""
    )
    click.echo(f"{who} is revoked.{words}")


@click.command(
    "join",
    epilog="""\b
examples:
  fleet join ABCD-EFGH-JKLM-NPQR-STUV-WXYZ
  fleet join 192.168.1.2 ABCD-EFGH-JKLM-NPQR-STUV-WXYZ
  fleet join 192.168.1.2 ABCD-EFGH-JKLM-NPQR-STUV-WXYZ --at 192.168.7.2
  zbarcam --raw --oneshot | fleet join -""",
)
@click.argument("words", nargs=-1, required=True, metavar="[HOST] CODE")
@click.option(
    "--at",
    "site",
    metavar="HOST[:PORT]",
    help="Use the hub of a site, at this address (127.0.0.1 on the computer of that hub).",
)
def join_hub(words: tuple[str, ...], site: str | None) -> None:
    """Join the hub on another computer, with the code that `fleet hub invite` shows there.

    Without HOST, the command searches for the hub in this network. It finds the right hub by the code. With - instead
    of HOST and CODE, it reads them from stdin, for example from a camera: `fleet hub invite --qr` draws them. All your
    programs then use that hub, until `fleet leave`. With the code of `fleet hub invite --site`, this computer becomes
    the hub of another site, which is linked to the first one.
    """
    with cli_errors(), _disk_errors():
        host, code = _host_and_code(words)
        parsed = JoinCode.parse(code)
        at, at_port = _address(site, 0) if site else ("", 0)
        name, port = _address(host, JOIN_PORT) if host else ("", 0)
        local_hub.check_storage(at or name, at_port)
        addresses = own_addresses()
        own = (*addresses, *own_names())
        if name:
            joined = join(name, parsed, port, addresses=own, own_authority=local_hub.is_authority_here)
        else:
            name, joined = join_one_of(hubs_found(addresses or [LOOPBACK]), parsed, own, local_hub.is_authority_here)
        endpoint = local_hub.store_joined(name, joined, at, at_port)
        if joined.rules:
            click.echo(
                f"This computer is the hub of {joined.identity} now, linked to {name}. `fleet up` starts it. Invite "
                f"its users on {name}, and let them join with --at. On this computer, that is `fleet join {name} CODE "
                "--at 127.0.0.1`."
            )
            _say_of_other_bus(endpoint)
            return
        said = _describe_cars_on(endpoint, SITE_RULES_S if site else HUB_RESTART_S)
    click.echo(f"You are {joined.identity} at {endpoint} now. {said}")
    _say_of_other_bus(endpoint)
    if joined.fleet_file and not DEFAULT_FLEET_FILE.exists():
        try:
            DEFAULT_FLEET_FILE.write_text(joined.fleet_file, encoding="utf-8")
        except OSError as error:  # this computer has joined all the same
            click.echo(f"{DEFAULT_FLEET_FILE} of the hub is not copied here: {error.strerror}", err=True)
        else:
            click.echo(f"{DEFAULT_FLEET_FILE} is a copy of the hub's.")


@click.command(epilog="\b\nexample:\n  fleet leave")
def leave() -> None:
    """Leave the hub that this computer has joined. The certificate on this computer is deleted.

    On the hub's own computer, its authority and certificates stay, and only the use of the hub ends.
    """
    with cli_errors(), _disk_errors():
        if joined_endpoint() and (cars := running_cars(resolve_endpoint())):
            raise click.ClickException(
                f"gateways run here ({', '.join(cars)}). They would lose their certificate while their cars may move. "
                "End them first (`fleet down`, Ctrl-C, or `systemctl stop`)"
            )
        endpoint, kept = local_hub.leave()
    if not endpoint:
        raise click.ClickException("this computer has not joined a hub")
    words = f"; its authority stays in {kept}, for the next `fleet up --secure`" if kept else ""
    click.echo(f"{endpoint} is no longer used{words}")


def _host_and_code(words: tuple[str, ...]) -> tuple[str, str]:
    """Return the host (empty if none was given) and the code. Raises click.UsageError."""
    if words == ("-",):
        words = tuple(sys.stdin.readline(MAX_JOIN_LINE).split())
    words = words[2:] if words[:2] == ("fleet", "join") else words
    if not 1 <= len(words) <= 2:
        raise click.UsageError("write the code, or host and code: fleet join [HOST] CODE")
    return words[0] if len(words) == 2 else "", words[-1]


def _address(written: str, default: int) -> tuple[str, int]:
    """Return host and port of HOST, HOST:PORT, or an IPv6 address in brackets. Raises click.UsageError."""
    found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^\[\]:/]+)(?::(\d{1,5}))?", written)
    if found is None or not 0 < int(found[2] or JOIN_PORT) < 65536:
        raise click.UsageError(f"{printable(written)} is not allowed: write HOST, HOST:PORT or [IPV6]:PORT")
    return found[1], int(found[2] or default)


def _describe_cars_on(endpoint: str, within_s: float) -> str:
    """Return a sentence about the cars that are on. Retry for `within_s`, because the hub may be restarting."""
    for is_last in _tries(within_s):
        try:
            with Bus.open(endpoint) as bus:
                cars = sorted(key.rpartition("/")[2] for key in bus.tokens(keys.car_token("*", "*")))
        except BusError:
            if is_last:
                return "Its hub does not answer yet; `fleet list` shows the cars once it does."
            continue
        if cars:
            return f"Cars: {', '.join(cars)}."
    return "Cars: none is on."


def _stop_first(endpoint: str, car: str) -> None:
    """Stop a car whose gateway is about to lose its certificate: nobody reaches it over the bus after that.

    Try for a while, because the hub may be restarting: its own certificate or its rules may just have changed.
    """
    for is_last in _tries(HUB_RESTART_S):
        try:
            with Fleet(endpoint, kind=Rank.PERSON) as client:
                outcome = client.car(car).stop() if car in client.cars() else None
        except BusError as error:
            if is_last:
                click.echo(f"{car} was not stopped: {error}", err=True)
            continue
        if outcome is not None and outcome.ok:
            click.echo(f"{car} was stopped first, because its gateway loses the bus now.", err=True)
            return
        if outcome is not None and is_last:
            click.echo(f"NOT STOPPED: {car}: {outcome.words} Its gateway loses the bus now: go to the car.", err=True)


def _tries(within_s: float) -> Iterator[bool]:
    """Yield once for each try within this time: True if it is the last one."""
    deadline = time.monotonic() + within_s
    while time.monotonic() <= deadline:
        yield False
        time.sleep(TRY_INTERVAL_S)
    yield True


def _say_of_other_bus(endpoint: str) -> None:
    """Warn if the environment keeps all commands from the hub at this endpoint."""
    if (other := os.environ.get(ENDPOINT_VARIABLE)) and other != endpoint:
        words = f"Your commands do not use this hub yet, because {ENDPOINT_VARIABLE} is {other}."
        click.echo(f"{words} Type: unset {ENDPOINT_VARIABLE}", err=True)


def _own_store(endpoint: str) -> HubStore:
    if not is_secure(endpoint) or not (store := HubStore.of(endpoint)).is_hub:
        if is_secure(endpoint) and (first := Credentials.of(endpoint).first_hubs):
            raise click.ClickException(
                f"This computer is the hub of another site: use these commands on {first[0]}, the main hub."
            )
        if os.environ.get(ENDPOINT_VARIABLE) and (joined := joined_endpoint()) and local_hub.is_hub_here(joined):
            raise click.ClickException(
                f"{ENDPOINT_VARIABLE} is {endpoint}, but this computer is the hub at {joined}. Type: "
                f"unset {ENDPOINT_VARIABLE}"
            )
        raise click.ClickException(
            f"This computer is not a hub ({endpoint}). `fleet hub init` makes it one. Only a hub has these commands."
        )
    return store


def _links(store: HubStore) -> dict[str, list[str]]:
    """Return the addresses from which each common name is connected."""
    try:
        found = json.loads((store.directory / LINKS_FILE).read_text(encoding="utf-8"))
        return {str(name): [str(each) for each in addresses] for name, addresses in found.items()}
    except (OSError, ValueError, AttributeError, TypeError):  # the list is only for information
        return {}


def _row(name: str, known: KnownIdentity, links: Mapping[str, Sequence[str]]) -> dict[str, str]:
    there = links.get(known.common_name(name), ())
    state = "revoked" if known.revoked else "connected" if there else "not connected"
    return {"identity": name, "state": state, "from": ", ".join(there) or "-", "until": known.until[:10]}


@contextmanager
def _disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise click.ClickException(f"{error.filename or 'the network'}: {error.strerror or error}") from None
