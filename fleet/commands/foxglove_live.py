"""`fleet foxglove`: shows the fleet live in Foxglove."""

import threading
from contextlib import closing
from typing import Final

import click

from fleet.bridges.foxglove_server import DEFAULT_FOXGLOVE_PORT, FoxgloveServer, PortInUse, layout_now
from fleet.commands.options import bus_options, serving_options
from fleet.commands.output import echo_safely
from fleet.commands.which_fleet import open_observer
from schemas.process import signals

_FOXGLOVE_INTERVAL_S: Final = 0.02
"""Interval at which the bus is read."""


@click.command(
    epilog="""\b
examples:
  fleet foxglove
  fleet foxglove --layout > layout.json
  fleet foxglove --address 192.168.1.2 --port 8766

In Foxglove: Open connection, Foxglove WebSocket, ws://localhost:8765. Everyone who can reach the address may look.
Nobody can command a car there."""
)
@serving_options(DEFAULT_FOXGLOVE_PORT)
@click.option(
    "--layout", "prints_layout", is_flag=True, help="Print a layout for the cars that are connected now, and exit."
)
@bus_options
def foxglove(*, port: int, address: str, prints_layout: bool, connect: str | None, fleet: str) -> None:
    """Serve everything that the fleet publishes to Foxglove, until Ctrl-C."""
    stop = threading.Event()
    signals.calls(stop.set)
    with open_observer(connect, fleet) as client:
        if prints_layout:
            click.echo(layout_now(client), nl=False)
            return
        try:
            server = FoxgloveServer(client, address, port)
        except PortInUse as error:
            hint = "`fleet foxglove --port 0` uses any free port."
            raise click.ClickException(f"{address}:{port} cannot be used: {error}. {hint}") from None
        with closing(server):
            click.echo(f"Foxglove: ws://{address}:{server.port} (Ctrl-C ends it)")
            while not stop.is_set():
                if not server.step():
                    stop.wait(_FOXGLOVE_INTERVAL_S)
        for line in server.left_out.words():
            echo_safely(f"not shown: {line}", err=True)
