"""`fleet scan` and `fleet sim`: run the tools of the same names of the `gateway` program."""

import os
import sys
from typing import Never

import click


@click.command(
    epilog="""\b
examples:
  fleet scan
  fleet scan --link /dev/ttyUSB0
  fleet scan --probe             # also ask silent ports: every car there stops
  fleet scan --json > report.json

Opening a USB port can reset an Arduino. TCP cars are not searched: closing the connection ends their program."""
)
@click.option("--link", "links", multiple=True, metavar="URL", help="Look at this link only; may be repeated.")
@click.option("--for", "listen", metavar="DURATION", help="How long to listen at each port (default 6s).")
@click.option("--probe", is_flag=True, help="Also ask silent ports. This stops every car that is there.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line.")
def scan(links: tuple[str, ...], listen: str | None, *, probe: bool, as_json: bool) -> None:
    """Look for cars on Bluetooth and serial ports. Only listens: no car moves."""
    words = [word for link in links for word in ("--link", link)]
    words += [] if listen is None else ["--for", listen]
    _run_gateway("scan", *words, *(["--probe"] if probe else []), *(["--json"] if as_json else []))


@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="""\b
examples:
  fleet sim --car red:arduino:pty --car blue:raspberry_pi:tcp://127.0.0.1:8888
  fleet sim --car red:arduino:pty --fault red:link_drop@5+2

OPTIONS are those of `gateway sim`: `gateway sim -h` lists them, with every fault. A whole simulated fleet: `fleet up
--sim 3`.""",
)
@click.argument("words", nargs=-1, type=click.UNPROCESSED, metavar="OPTIONS...")
def sim(words: tuple[str, ...]) -> None:
    """Run simulated cars alone, without a fleet: for tests of your own programs, and for faults of links."""
    _run_gateway("sim", *words)


def _run_gateway(*words: str) -> Never:
    """Replace this process by the gateway program, which then has our terminal and signals."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "gateway", *words])  # noqa: S606 - our own interpreter
