"""`fleet exporter`: the fleet as metrics for Prometheus."""

import errno
import json
import threading

import click

from fleet.commands.options import bus_options, serving_options
from fleet.commands.which_fleet import open_observer
from fleet.exporter.dashboard import dashboard
from fleet.exporter.exporter import DEFAULT_EXPORTER_PORT, Exporter
from schemas.process import signals


@click.command(
    epilog="""\b
examples:
  fleet exporter
  fleet exporter --address 192.168.1.2 --port 9478
  fleet exporter --dashboard > grafana.json

Prometheus reads http://127.0.0.1:9478/metrics. Everyone who can reach the address may read the metrics.
Nobody can command a car there."""
)
@serving_options(DEFAULT_EXPORTER_PORT)
@click.option("--dashboard", "prints_board", is_flag=True, help="Print a dashboard for Grafana, and exit.")
@bus_options
def exporter(*, port: int, address: str, prints_board: bool, connect: str | None, fleet: str) -> None:
    """Serve the state of all cars and of the recorder as metrics for Prometheus, until Ctrl-C."""
    if prints_board:
        click.echo(json.dumps(dashboard(), indent=1))
        return
    stop = threading.Event()
    signals.calls(stop.set)
    with open_observer(connect, fleet) as client:
        served = Exporter(client)
        try:
            port, close = served.serve(address, port)
        except OSError as error:
            hint = " `fleet exporter --port 0` uses any free port." if error.errno == errno.EADDRINUSE else ""
            words = f"{address}:{port} cannot be used: {error.strerror or error}.{hint}"
            raise click.ClickException(words) from None
        click.echo(f"Metrics: http://{address}:{port}/metrics (Ctrl-C ends it)")
        try:
            served.run(stop.is_set)
        finally:
            close()
