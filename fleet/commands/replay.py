"""`fleet replay`: shows a session in Rerun, or saves it as a Rerun file with a layout."""

import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fleet.commands.car_names import car_option
from fleet.commands.options import from_option, to_option
from fleet.commands.output import progress_bar
from fleet.commands.params import session_argument
from schemas.printable import printable_lines
from schemas.process import signals, startup

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session
    from fleet.replay.rerun.rrd_export import Part


@click.command(epilog="\b\nexamples:\n  fleet replay\n  fleet replay latest~1 --car red --from=-60s --save red.rrd")
@session_argument
@car_option
@from_option
@to_option
@click.option(
    "--save",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="OUT.rrd",
    help="Write a file (with its layout) instead of opening the viewer. `rerun OUT.rrd` shows it.",
)
def replay(
    session: Path,
    cars: tuple[str, ...],
    start: str | None,
    end: str | None,
    save: Path | None,
) -> None:
    """Look at a session in Rerun: the newest, or a directory or .mcap file that you name."""
    quiet_rerun()
    from fleet.recording.reading.session import NoSession, Session
    from fleet.recording.tools.summary import typed_name
    from fleet.replay.rerun.viewer import has_display

    try:
        found = Session(session)
        found.check()
        if save is not None:
            check_target(save, found.segments)
        elif not has_display():
            raise click.ClickException(
                "there is no display here to open Rerun on: write a file, "
                f"fleet replay {typed_name(found)} --save out.rrd"
            )
        part = _part(found, cars, start, end)
        with tempfile.TemporaryDirectory() as scratch:
            out = save if save is not None else Path(scratch) / f"{found.name}.rrd"
            must_say_damage = True
            try:
                _export(found, out, part, cars, name=found.name if save is None else str(save))
            except NoSession:
                must_say_damage = False  # this error names the damage
                raise
            finally:  # only an export finds all damage
                if found.damage and must_say_damage:
                    click.echo(printable_lines(f"{found.damage_words}; showing only the intact part"), err=True)
            if save is None:
                sys.exit(_view(out))
    except NoSession as error:
        raise click.ClickException(str(error)) from None


def check_target(save: Path, segments: Iterable[Path] = ()) -> None:
    """Raise a UsageError for a target that is the recording itself, no regular file, or not named .rrd."""
    if save.suffix != ".rrd":
        raise click.UsageError(
            f"--save {save}: Rerun opens only files that end in .rrd: name it {save.stem.strip('.') or 'out'}.rrd"
        )
    if save.exists() and not save.is_file():
        raise click.UsageError(f"--save {save}: this is not a file: name a file that ends in .rrd")
    for segment in segments:
        if save.exists() and save.samefile(segment):
            raise click.UsageError(f"--save {save}: this is the recording itself: name another file")


def _part(session: "Session", cars: tuple[str, ...], start: str | None, end: str | None) -> "Part":
    from fleet.replay.rerun.rrd_export import WHOLE_SESSION, Part

    if not cars and start is None and end is None:
        return WHOLE_SESSION
    from fleet.commands.session_part import part_of

    selection = part_of(session, start, end, cars)
    return Part(cars, selection.start_ns, selection.end_ns)


def quiet_rerun() -> None:
    """Turn off Rerun's log, which would mix with our output. Raises ModuleNotFoundError if Rerun is not installed."""
    os.environ.setdefault("RUST_LOG", "off")  # read when Rerun is imported
    if find_spec("rerun") is None:
        raise ModuleNotFoundError(name="rerun")


def _export(session: "Session", out: Path, part: "Part", cars: tuple[str, ...], name: str) -> None:
    from fleet.replay.rerun.rrd_export import ExportFailed, export

    try:
        # Rerun calls Python for each chunk, and may lose an exception there. So Ctrl-C takes effect between two chunks.
        with _progress_bar(session) as advance, signals.held_back() as came:

            def on_read(messages: int) -> None:
                if came:
                    raise KeyboardInterrupt
                advance(messages)

            replayed = export(session, out, part, tab=cars[0] if len(cars) == 1 else "", on_read=on_read)
    except ExportFailed as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(
            f"{out} cannot be written: {error.strerror}. The export needs twice the size of the recording; "
            "name another place (--save), or set TMPDIR to a directory with room."
        ) from None
    click.echo(f"{name}: {replayed.shown.total()} messages on {len(replayed.shown)} keys")
    for line in replayed.left_out.words():
        click.echo(f"not shown: {line}", err=True)


@contextmanager
def _progress_bar(session: "Session") -> Iterator[Callable[[int], None]]:
    """Show a progress bar. Yield the function to call with the number of newly read messages."""
    from fleet.replay.rerun.rrd_export import count_of

    with progress_bar("replay", count_of(session) if sys.stderr.isatty() else 0) as advance:
        yield advance


def _view(rrd: Path) -> int:
    """Run Rerun's viewer until its window is closed. Return the exit code."""
    from fleet.replay.rerun.viewer import Viewer

    with Viewer("--port", "auto", str(rrd)) as viewer:
        try:
            code = viewer.wait() or 0
        except KeyboardInterrupt:
            return startup.INTERRUPTED
        if code:
            click.echo(f"fleet: Rerun's viewer ended with {code}: {viewer.last_error}", err=True)
        return 1 if code else 0
