"""`fleet view`: shows the fleet live in Rerun."""

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

import click

from fleet.commands.options import bus_options
from fleet.commands.params import Duration
from fleet.commands.replay import check_target, quiet_rerun
from schemas import keys

if TYPE_CHECKING:
    from fleet.replay.rerun.viewer import Viewer

_DAY_S: Final = 86_400.0
MEMORY: Final = "1GiB"
LAYOUT_DELAY_S: Final = 1.5
"""Delay of the first layout, so that the tabs do not change while the user clicks on them."""


@click.command(epilog="\b\nexamples:\n  fleet view\n  fleet view --web\n  fleet view --save now.rrd --for 30s")
@click.option(
    "--web", is_flag=True, help="Serve the viewer as a web page on this computer only, and print its address."
)
@click.option(
    "--save",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="OUT.rrd",
    help="Write a file (with its layout) instead of opening the viewer.",
)
@click.option("--for", "seconds", type=Duration(_DAY_S), help="End after DURATION.")
@click.option(
    "--memory",
    default=MEMORY,
    show_default=True,
    metavar="SIZE",
    help="Maximum memory of the viewer. It drops the oldest data first.",
)
@bus_options
def view(*, web: bool, save: Path | None, seconds: float | None, memory: str, connect: str | None, fleet: str) -> None:
    """Show the fleet live in Rerun, until you close its window or press Ctrl-C. This does not affect the cars."""
    if web and save is not None:
        raise click.UsageError("--web and --save exclude each other: give one of them.")
    if not re.fullmatch(r"[1-9]\d*(\.\d+)?([KMG]i?B|%)", memory):
        raise click.UsageError(f"--memory {memory} is not allowed: write 500MB, 1GiB or 25%")
    keys.check_name(fleet, "fleet name")
    if save is not None:
        check_target(save)
        if not save.resolve().parent.is_dir():
            raise click.UsageError(f"--save {save}: there is no directory {save.parent}")
    quiet_rerun()
    from fleet.replay.rerun.viewer import NoViewer, has_display

    if save is None and not web and not has_display():
        raise click.ClickException(
            "there is no display here to open Rerun on: --web serves it as a page, --save out.rrd writes a file"
        )
    try:
        _follow(connect, fleet, save, memory, seconds, web=web)
    except NoViewer as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(f"{save or error.filename} cannot be written: {error.strerror}") from None


def _follow(
    connect: str | None, fleet: str, save: Path | None, memory: str, seconds: float | None, *, web: bool
) -> None:
    from fleet.replay.rerun.live import DEFAULT_VIEW_S, VIEW_INTERVAL_S, Live
    from schemas.bus import Bus

    stop = threading.Event()
    until = time.monotonic() + seconds if seconds is not None else None
    with _signals(stop), Bus.open(connect) as bus, _sink(save, memory, web=web) as (viewer, sink):
        live = Live(bus, fleet, sink, last_s=None if save is not None else DEFAULT_VIEW_S)
        try:
            live.start()
            pause = LAYOUT_DELAY_S
            while not stop.wait(pause) and (viewer is None or viewer.ended is None):
                live.step()
                if until is not None and time.monotonic() > until:
                    break
                pause = VIEW_INTERVAL_S
        finally:
            live.close(send=viewer is None or viewer.ended is None)
        lost = f"; {live.dropped} were dropped because the viewer was too slow" if live.dropped else ""
        words = f"{save}: " if save is not None else ""
        click.echo(f"{words}{live.sent} messages of {len(live.cars)} cars{lost}", err=save is None)
        for line in live.left_out.words():
            click.echo(f"not shown: {line}", err=True)


@contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    """Set `stop` on Ctrl-C and SIGTERM."""

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _sink(save: Path | None, memory: str, *, web: bool) -> "Iterator[tuple[Viewer | None, Callable[[Any], None]]]":
    """Yield the running viewer (None for a file) and the function that connects a recording to it."""
    from fleet.replay.rerun.viewer import VIEWER_HOST, Viewer, free_port

    if save is not None:
        yield None, lambda recording: recording.save(save)
        return
    port, page = free_port(), free_port()
    bounded = ("--memory-limit", memory, "--server-memory-limit", memory)
    if web:
        arguments = ["--serve-web", "--web-viewer-port", str(page)]
    else:
        arguments = ["--expect-data-soon", "--hide-welcome-screen"]
    with Viewer("--port", str(port), *bounded, *arguments) as viewer:
        viewer.wait_until_it_listens(page if web else port)
        url = f"rerun+http://{VIEWER_HOST}:{port}/proxy"
        if web:
            click.echo(f"http://{VIEWER_HOST}:{page}/?url={url.replace('+', '%2B')}")
        yield viewer, lambda recording: recording.connect_grpc(url)
