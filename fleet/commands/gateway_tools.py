"""`fleet scan` and `fleet sim`: run the `gateway` program's commands of the same names."""

import os
import sys
from typing import Never

import click


@click.command(
    epilog="""\b
examples:
  fleet scan
  fleet scan --link /dev/ttyUSB0
  fleet scan --probe             # also send a stop, which stops cars in mode manual
  fleet scan --json > report.json

Opening a USB port can reset an Arduino. `fleet scan` does not search for TCP cars, because their program ends
when a connection to it ends."""
)
@click.option("--link", "links", multiple=True, metavar="URL", help="Look only at this link. Repeatable.")
@click.option("--for", "listen", metavar="DURATION", help="How long to listen at each port (default: 6s).")
@click.option("--probe", is_flag=True, help="Send a stop to cars and to silent ports. It stops cars in mode manual.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
def scan(links: tuple[str, ...], listen: str | None, *, probe: bool, as_json: bool) -> None:
    """Look for cars on Bluetooth and serial ports. Without --probe, it only listens. No scan makes a car move."""
    words = [word for link in links for word in ("--link", link)]
    if listen is not None:
        words += ["--for", listen]
    _run_gateway("scan", *words, *(["--probe"] if probe else []), *(["--json"] if as_json else []))


@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="""\b
examples:
  fleet sim --car red:arduino:pty --car blue:raspberry_pi:tcp://127.0.0.1:8888
  fleet sim --car red:arduino:pty --fault red:link_drop@5+2

OPTIONS are the options of `gateway sim`. `gateway sim -h` lists them, and every fault. `fleet up --sim 3` starts a
whole simulated fleet.""",
)
@click.argument("words", nargs=-1, type=click.UNPROCESSED, metavar="OPTIONS...")
def sim(words: tuple[str, ...]) -> None:
    """Run simulated cars without a fleet, to test your own programs and to simulate faults of links."""
    _run_gateway("sim", *words)


def _run_gateway(*words: str) -> Never:
    """Replace this process with the gateway program, which then has our terminal and signals."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "gateway", *words])  # noqa: S606 - our own interpreter
