"""Common options of the subcommands, and their client on the bus."""

import functools
from collections.abc import Callable
from typing import Any

import click

from fleet.commands.car_names import complete_people
from fleet.commands.command_group import as_option, connect_option, fleet_option, remember_fleet
from fleet.commands.exit_code import cli_errors
from fleet.commands.params import Number
from fleet.commands.which_fleet import open_client
from schemas.bus import LOOPBACK

_Function = Callable[..., Any]

from_option = click.option(
    "--from",
    "start",
    metavar="TIME",
    help="Begin at TIME: 90s after the start, -5m before the end, a local time (14:05), or a date.",
)
to_option = click.option("--to", "end", metavar="TIME", help="End before TIME, written as for --from.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
take_option = click.option("--take", is_flag=True, help="Take the car over from another person.")


def bus_options(function: _Function) -> _Function:
    """Add --connect, --fleet and --as. The command runs in `cli_errors`."""

    @connect_option()
    @fleet_option()
    @as_option(complete_people)
    @functools.wraps(function)
    def command(*args: Any, **options: Any) -> Any:
        remember_fleet(options["connect"], options["fleet"])
        with cli_errors():
            return function(*args, **options)

    return command


def serving_options(port: int) -> Callable[[_Function], _Function]:
    """Add --port and --address for a program that serves others. By default it serves `port` on this computer only."""

    def add(function: _Function) -> _Function:
        address_option = click.option(
            "--address", metavar="ADDRESS", default=LOOPBACK, show_default=True, help="Serve at this address."
        )
        port_option = click.option(
            "--port",
            type=Number(int, 0, 65535),
            default=port,
            show_default=True,
            help="Serve at this port. With 0, at any free port.",
        )
        return port_option(address_option(function))

    return add


def with_client(function: _Function) -> _Function:
    """Add the options of `bus_options`, and pass the command an open client, which acts for the person of --as."""

    @bus_options
    @functools.wraps(function)
    def command(*args: Any, connect: str | None, fleet: str, **options: Any) -> Any:
        named = options.get("cars") or options.get("car") or ()
        with open_client(connect, fleet, [named] if isinstance(named, str) else named) as client:
            return function(client, *args, **options)

    return command
