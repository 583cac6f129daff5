"""A picture of an .rrd in Rerun's viewer, without a screen: `python -m fleet.replay.picture SESSION.rrd OUT.png`.

Needs a Vulkan driver that draws in software where there is no graphics card (Debian: `mesa-vulkan-drivers`).
"""

import contextlib
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import click

from fleet.replay.viewer import environment, program

SIZE: Final = "1600x900"
UP_WITHIN_S: Final = 30.0
SETTLE_S: Final = 3.0
"""The viewer offers no sign that it has drawn everything; a software renderer draws a few frames a second."""
DRIVERS: Final = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")


class NoPicture(Exception):
    """There is no picture; its text says what is missing."""


def take(rrd: Path, out: Path) -> None:
    """Draw `rrd` as its layout says, into a PNG. Raises NoPicture."""
    with tempfile.TemporaryDirectory() as home:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        words = Path(home) / "words"
        with _viewer(port, Path(home), words):
            client = _connect(port, words)
            client.open(str(rrd.resolve()))
            time.sleep(SETTLE_S)
            client.save_screenshot(str(out.resolve()))


@contextlib.contextmanager
def _viewer(port: int, home: Path, words: Path) -> Iterator[None]:
    """Rerun's viewer without a window, with a home of its own: driver caches and settings stay out of the user's."""
    own = {
        name: str(home) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR")
    }
    # Among the installed drivers the one that needs no card; without it a machine's broken card would be tried first.
    software = [str(found) for place in DRIVERS for found in sorted(Path(place).glob("lvp_icd*.json"))]
    if software and "VK_ICD_FILENAMES" not in os.environ:
        own["VK_ICD_FILENAMES"] = software[0]
    command = [str(program()), "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", SIZE]
    with words.open("wb") as log:
        process = subprocess.Popen(command, env={**environment(), **own}, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def _connect(port: int, words: Path) -> Any:
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + UP_WITHIN_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except (RuntimeError, OSError, ValueError):  # how it says that nothing answers yet
            said = words.read_text(errors="replace").strip().splitlines()
            if time.monotonic() > deadline or any("adapter" in line or "panicked" in line for line in said):
                raise NoPicture(
                    "Rerun's viewer cannot draw here: it needs a graphics driver, or one in software "
                    f"(Debian: apt install mesa-vulkan-drivers). It said: {said[-1] if said else 'nothing'}"
                ) from None
            time.sleep(0.1)
        else:
            return client


@click.command()
@click.argument("rrd", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
def main(rrd: Path, out: Path) -> None:
    """Draw the .rrd of `fleet replay --save` as its layout says, into a PNG."""
    try:
        take(rrd, out)
    except NoPicture as error:
        raise click.ClickException(str(error)) from None
    click.echo(f"{out}: {out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
