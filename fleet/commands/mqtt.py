"""`fleet mqtt`: the cars as devices of Home Assistant."""

import asyncio
import os
import ssl
from importlib.metadata import version
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import click

from fleet.bridges.home_assistant import DISCOVERY_PREFIX, HomeAssistant
from fleet.bridges.mqtt_bridge import PLAIN_PORT, TLS_PORT, Broker, BrokerRefused, MqttBridge
from fleet.commands.options import bus_options
from fleet.commands.output import echo_safely
from fleet.commands.which_fleet import open_observer

PASSWORD_VARIABLE: Final = "FLEET_MQTT_PASSWORD"  # noqa: S105 - the name of the variable
"""The password is not an option, because everybody on this computer can read a command line."""


@click.command(
    epilog="""\b
examples:
  fleet mqtt
  FLEET_MQTT_PASSWORD=... fleet mqtt --broker mqtts://home.example --user cars

Home Assistant adds a device for each car without any setup. No message over MQTT can command a car."""
)
@click.option(
    "--broker",
    metavar="URL",
    default=f"mqtt://127.0.0.1:{PLAIN_PORT}",
    show_default=True,
    help="URL of the broker: mqtt://HOST[:PORT], or mqtts:// for TLS.",
)
@click.option("--user", metavar="NAME", help=f"User name at the broker. The password is read from {PASSWORD_VARIABLE}.")
@click.option(
    "--ca",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Trust the authority in this PEM file, for mqtts:// (default: the authorities of this computer).",
)
@click.option(
    "--discovery",
    metavar="PREFIX",
    default=DISCOVERY_PREFIX,
    show_default=True,
    help="First part of the topics for announcements, as set in Home Assistant.",
)
@bus_options
def mqtt(*, broker: str, user: str | None, ca: Path | None, discovery: str, connect: str | None, fleet: str) -> None:
    """Publish readings and states of the cars to an MQTT broker, until Ctrl-C.

    Home Assistant finds the cars by itself.
    """
    where = _broker(broker, user, ca)
    if not discovery or set(discovery) & set("+#") or discovery != discovery.strip("/"):
        raise click.UsageError(
            f"--discovery {discovery!r} is not allowed: write parts with one / between them, without + and #"
        )
    with open_observer(connect, fleet) as client:
        plan = HomeAssistant(client.name, discovery, version("zenoh-car-fleet"))
        try:
            asyncio.run(MqttBridge(client, where, plan, echo_safely).run())
        except BrokerRefused as error:
            raise click.ClickException(f"{error}. Name them with --user and {PASSWORD_VARIABLE}.") from None


def _broker(url: str, user: str | None, ca: Path | None) -> Broker:
    """Return the broker of a URL. Raises click.UsageError."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or parts.path.strip("/") or "@" in parts.netloc:
        raise click.UsageError(f"--broker {url} is not allowed: write mqtt://HOST, mqtt://HOST:PORT or mqtts://HOST")
    tls = None
    if parts.scheme == "mqtts":
        try:
            tls = ssl.create_default_context(cafile=None if ca is None else str(ca))
        except (OSError, ValueError):
            raise click.UsageError(f"--ca {ca}: no certificate in PEM format") from None
    elif ca is not None:
        raise click.UsageError("--ca needs a broker with TLS: --broker mqtts://HOST")
    default = PLAIN_PORT if tls is None else TLS_PORT
    return Broker(parts.hostname, port or default, user, os.environ.get(PASSWORD_VARIABLE), tls)
