"""`fleet replay`: a session in Rerun, in its viewer or as a file that carries its layout."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fleet.recording.session import Session


@click.command()
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--save",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="OUT.rrd",
    help="Write a file that carries its layout instead of opening the viewer: `rerun OUT.rrd` shows it.",
)
def replay(session: Path, save: Path | None) -> None:  # fmt: skip
    """Look at SESSION (a directory that `fleet record` made, or an .mcap) in Rerun."""
    from fleet.recording.session import NoSession, Session
    from fleet.replay.viewer import has_display

    try:
        found = Session.open(session)
        found.check()
        if save is not None:
            _refuse_target(save, found.segments)
        elif not has_display():
            raise click.ClickException(
                f"there is no display here to open Rerun on: write a file, fleet replay {session} --save out.rrd"
            )
        with tempfile.TemporaryDirectory() as scratch:
            if found.damage:
                # What is whole is copied first: Rerun's own reader shows also what fails its checksum.
                whole = _rescue(found, Path(scratch) / f"{found.name}.mcap")
                click.echo(f"{found.damage_words}; showing what is whole", err=True)
                found = whole
            out = save if save is not None else Path(scratch) / f"{found.name}.rrd"
            _export(found, out)
            if save is None:
                sys.exit(_view(out))
    except NoSession as error:
        raise click.ClickException(str(error)) from None


def _refuse_target(save: Path, segments: Iterable[Path]) -> None:
    """A recording or a device is not to be overwritten."""
    if save.suffix != ".rrd":
        raise click.UsageError(
            f"--save {save}: Rerun opens files that end in .rrd: name it {save.stem.strip('.') or 'out'}.rrd"
        )
    if save.exists() and not save.is_file():
        raise click.UsageError(f"--save {save}: this is no file: name one that ends in .rrd")
    for segment in segments:
        if save.exists() and save.samefile(segment):
            raise click.UsageError(f"--save {save}: this is the recording itself: name another file")


def _rescue(session: "Session", out: Path) -> "Session":
    try:
        return session.rescue(out)
    except OSError as error:
        raise click.ClickException(
            f"what is whole of {session.path} cannot be copied to {out.parent}: {error.strerror}; "
            "set TMPDIR to a directory with room"
        ) from None


def _export(session: "Session", out: Path) -> None:
    # Rerun has a log of its own, which would stand between our lines; it reads this when it is imported.
    os.environ.setdefault("RUST_LOG", "off")
    from fleet.replay.to_rerun import ExportFailed, export

    try:
        held = export(session, out)
    except ExportFailed as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(f"{out} cannot be written: {error.strerror}") from None
    click.echo(f"{out}: {held.total()} messages on {len(held)} keys")


def _view(rrd: Path) -> int:
    """Rerun's viewer until its window is closed; it listens on loopback only."""
    from fleet.replay.viewer import environment, program

    viewer = subprocess.Popen([str(program()), "--bind", "127.0.0.1", "--port", "auto", str(rrd)], env=environment())
    try:
        return viewer.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        viewer.terminate()
        viewer.wait()
