"""`fleet console`: a web page that shows the fleet, drives cars and stops them."""

import asyncio
import ipaddress
import webbrowser
from typing import Any, Final

import click

from fleet.aio import Fleet
from fleet.commands.options import bus_options
from fleet.commands.params import Number
from fleet.console.server import DEFAULT_PORT, LOOPBACK, listen, serve

_LOOPBACK_NAMES: Final = ("localhost", "::1")


def _check_host(_: click.Context, __: click.Parameter, host: str) -> str:
    """Refuse every address but loopback."""
    try:
        is_loopback = host in _LOOPBACK_NAMES or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_loopback = False
    if not is_loopback:
        raise click.UsageError(
            f"The console serves this computer only, not {host}: everyone who reaches it drives the cars. "
            f"From another computer, type there: ssh -L {DEFAULT_PORT}:{LOOPBACK}:{DEFAULT_PORT} USER@THIS_COMPUTER"
        )
    return host


@click.command(
    epilog="""\b
examples:
  fleet console
  fleet console --open
  fleet console --port 8080"""
)
@click.option(
    "--port", type=Number(int, 0, 65535), default=DEFAULT_PORT, show_default=True, help="Port, 0 for any free one."
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default=LOOPBACK,
    show_default=True,
    callback=_check_host,
    expose_value=False,
    help="Address: loopback only.",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@bus_options
def console(*, port: int, opens: bool, connect: str | None, fleet: str) -> None:
    """Serve the fleet as a web page on this computer, until Ctrl-C. STOP is Escape on every page."""
    try:
        listener = listen(port)
    except OSError as error:
        raise click.ClickException(
            f"Port {port} is not free ({error.strerror}). `fleet console --port 0` takes a free one."
        ) from None
    address = f"http://{LOOPBACK}:{listener.getsockname()[1]}"

    def on_ready() -> None:
        click.echo(f"Console: {address} (Ctrl-C ends it)")
        if opens:
            webbrowser.open(address)

    async def run() -> Any:
        async with Fleet(connect, fleet, kind="person") as client:
            await serve(client, listener, on_ready)

    with listener:
        asyncio.run(run())
