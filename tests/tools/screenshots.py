"""Pictures of a session in Rerun's viewer, without a screen: `python -m tests.tools.screenshots SESSION DIRECTORY`.

The pictures are `car.png` (the lanes of the last car) and, of simulated cars, `world.png`. Without a graphics card,
they need a Vulkan driver that draws in software (Debian: `mesa-vulkan-drivers`).
"""

import contextlib
import io
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from fleet.replay.rerun.viewer import VIEWER_POLL_INTERVAL_S, Viewer, free_port

SIZE: Final = "1920x1080"
AT: Final = 0.75
"""Position of the cursor, as a share of the session's time."""
UP_WITHIN_S: Final = 30.0
DRAWN_WITHIN_S: Final = 120.0
SETTLE_S: Final = 1.0
"""Time between two equal pictures that show the end of drawing. The viewer does not report this end."""
DRIVERS: Final = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
COLOURS: Final = 255
WORLD: Final = "World, from above"
LANES: Final = (0, 93, 960, 768)
"""The part of a car's picture with its lanes in a readable size, without the viewer's bars."""


class NoPicture(Exception):
    """There is no picture. The text names the missing part."""


@dataclass(frozen=True, slots=True)
class Shown:
    """The viewer's report about its views."""

    views: tuple[str, ...]
    """Names of all views, on every tab."""
    faults: tuple[str, ...]
    """Faults of views, with the causes."""


def software_driver() -> str | None:
    """Return the installed driver that needs no card, None if there is none.

    Without its name, Vulkan would try a broken card first.
    """
    found = [str(each) for place in DRIVERS for each in sorted(Path(place).glob("lvp_icd*.json"))]
    return found[0] if found else None


def take(rrd: Path, out: Path, view: str = "") -> Shown:
    """Draw `rrd` with its layout into a PNG: all of it, or the view whose name begins with `view`. Raise NoPicture."""
    port = free_port()
    with tempfile.TemporaryDirectory() as home, _viewer(port, Path(home)) as viewer:
        try:
            png, shown = _look(_connect(viewer, port), rrd, view)
        except (RuntimeError, OSError, ValueError):  # the viewer does not answer, or no longer
            viewer.wait(SETTLE_S)
            raise NoPicture(
                "Rerun's viewer cannot draw here: it needs a graphics driver, or one in software "
                f"(Debian: apt install mesa-vulkan-drivers). It said: {viewer.last_error}"
            ) from None
    _write(png, out)
    return shown


def _look(client: Any, rrd: Path, view: str) -> tuple[bytes, Shown]:
    client.open(str(rrd.resolve()))
    state = _loaded(client)
    recording = state.recordings[0]
    times = next(each for each in recording.timelines if each.name == recording.current_timeline)
    client.set_time(timestamp=(times.start + AT * (times.end - times.start)) / 1e9, play_state="paused")
    wanted = [each.view_id for each in state.views if view and each.name.startswith(view)]
    if view and not wanted:
        raise NoPicture(f"{rrd} has no view {view}: there are {', '.join(each.name for each in state.views)}")
    png = _drawn(client, wanted[0] if wanted else None)
    views = client.get_state().views
    faults = tuple(f"{each.name}: {report}" for each in views for report in each.reports)
    return png, Shown(tuple(each.name for each in views), faults)


def pictures(session: Path, folder: Path, car: int = 0) -> dict[str, Shown]:
    """Make the pictures of a session. Return the views by file name. Raise NoPicture, NoSession and ExportFailed."""
    from fleet.recording.reading.session import Session
    from fleet.replay.rerun.rrd_export import export

    found = Session(session)
    made: dict[str, Shown] = {}
    with tempfile.TemporaryDirectory() as scratch:
        rrd = Path(scratch) / f"{found.name}.rrd"
        held = export(found, rrd).shown
        made["fleet.png"] = take(rrd, folder / "fleet.png")
        if any(view.startswith(WORLD) for view in made["fleet.png"].views):
            made["world.png"] = take(rrd, folder / "world.png", WORLD)
        cars = sorted({key.split("/")[1] for key in held} - {key.split("/")[1] for key in held if "/@" in key})
        if cars:
            export(found, rrd, tab=cars[car])
            made["car.png"] = take(rrd, folder / "car.png")
    return made


def _loaded(client: Any) -> Any:
    """Wait until the viewer has loaded the whole recording. Return the viewer's state.

    A partly loaded recording already has a time with an end.
    """
    deadline = time.monotonic() + UP_WITHIN_S
    while (state := client.get_state()).loading or not (
        state.recordings and state.recordings[0].timelines and state.views
    ):
        if time.monotonic() > deadline:
            raise NoPicture("Rerun's viewer did not load the session")
        time.sleep(0.1)
    return state


def _drawn(client: Any, view_id: str | None) -> bytes:
    """Return a picture once two in a row are equal, or the last picture at the deadline."""
    deadline = time.monotonic() + DRAWN_WITHIN_S
    last = _screenshot(client, view_id, deadline)
    while time.monotonic() < deadline:
        time.sleep(SETTLE_S)
        now = _screenshot(client, view_id, deadline)
        if now == last:
            break
        last = now
    return last


def _screenshot(client: Any, view_id: str | None, deadline: float) -> bytes:
    """Return a picture. Retry until the deadline.

    The viewer gives up after five seconds, too soon on a busy machine without a card.
    """
    while True:
        try:
            png: bytes = client.take_screenshot(view_id)
        except RuntimeError:
            if time.monotonic() > deadline:
                raise
        else:
            return png


def _write(png: bytes, out: Path) -> None:
    """Write a picture with a palette. This saves two thirds of the bytes without a visible difference."""
    from PIL import Image  # rerun-sdk depends on it

    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").quantize(COLOURS).save(out, optimize=True)


@contextlib.contextmanager
def _viewer(port: int, home: Path) -> Iterator[Viewer]:
    """Start Rerun's viewer without a window, in a home of its own, away from the user's caches and settings."""
    own = {
        name: str(home) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_RUNTIME_DIR")
    }
    driver = software_driver()
    if driver and "VK_ICD_FILENAMES" not in os.environ:
        own["VK_ICD_FILENAMES"] = driver
    with Viewer("--headless", "--port", str(port), "--window-size", SIZE, extra=own) as viewer:
        yield viewer


def _connect(viewer: Viewer, port: int) -> Any:
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + UP_WITHIN_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except (RuntimeError, OSError, ValueError):  # the viewer does not answer yet
            if viewer.wait(VIEWER_POLL_INTERVAL_S) is not None or time.monotonic() > deadline:
                raise
        else:
            return client


@click.command()
@click.argument("session", type=click.Path(path_type=Path))
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(session: Path, directory: Path) -> None:
    """Draw the lanes of SESSION's last car and the simulated world into PNGs in DIRECTORY."""
    from fleet.recording.reading.session import NoSession
    from fleet.replay.rerun.rrd_export import ExportFailed

    try:
        made = pictures(session, directory, -1)
    except (NoPicture, NoSession, ExportFailed) as error:
        raise click.ClickException(str(error)) from None
    from PIL import Image

    (directory / "fleet.png").unlink()  # too wide for a page
    with Image.open(directory / "car.png") as whole:
        lanes = whole.crop(LANES)
    lanes.save(directory / "car.png", optimize=True)
    for name, shown in list(made.items())[1:]:
        click.echo(f"{directory / name}: {(directory / name).stat().st_size} bytes")
        for fault in shown.faults:
            click.echo(f"not shown: {fault}", err=True)


if __name__ == "__main__":
    main()
