"""`fleet sessions`: lists, verifies, recovers, cuts and exports recordings."""

import json
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from fleet.commands.car_names import car_option
from fleet.commands.command_group import DefaultCommandGroup
from fleet.commands.options import from_option, json_option, to_option
from fleet.commands.output import aligned, echo_safely, with_progress
from fleet.commands.params import SessionPath, session_argument
from fleet.commands.redecode import redecode, vector
from fleet.commands.session_part import part_of
from fleet.recording import time_spec
from fleet.recording.session_dir import REMOVED_FILE, removed_sessions
from fleet.recording.session_lookup import sessions_place
from schemas.keys import name_of
from schemas.local_time import date_and_clock, of_iso
from schemas.printable import printable

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session
    from fleet.recording.tools.summary import SessionSummary


@click.group(
    cls=DefaultCommandGroup,
    default_command="list",
    subcommand_metavar="[COMMAND | DIR]",
    epilog="""\b
examples:
  fleet sessions
  fleet sessions verify latest~1
  fleet sessions export --csv tables
""",
)
def sessions() -> None:
    """List, inspect, check, repair, cut and export recordings. Without a command, list the recordings in DIR."""


sessions.add_command(redecode)
sessions.add_command(vector)

_COLUMNS: Final = ("session", "start", "state", "length", "size", "messages", "lost", "stops", "marks", "cars")

_new_session_option = partial(
    click.option,
    "-o",
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
)
out_option = _new_session_option(help="Write the new session to DIR (default: SESSION-recovered, beside the session).")
required_out_option = _new_session_option(required=True, help="Write the new session to DIR.")


@contextmanager
def _session_errors(out: Path | None = None) -> Iterator[None]:
    """Turn expected errors into one line."""
    from fleet.recording.reading.session import NoSession
    from fleet.recording.tools.merge_cut_recover import Exists
    from fleet.recording.tools.table_formats import FormatMissing

    try:
        yield
    except Exists as error:
        raise click.UsageError(str(error)) from None
    except (NoSession, FormatMissing) as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        if out is None or isinstance(error, BrokenPipeError):
            raise
        raise click.ClickException(
            f"{out} cannot be written: {error.strerror or error}; nothing was left there"
        ) from None


def _open(path: Path) -> "Session":
    from fleet.recording.reading.session import Session

    return Session(path)


@sessions.command(
    "list",
    epilog="\b\nexamples:\n  fleet sessions list\n  fleet sessions list /media/disk/sessions --json\n",
)
@click.argument("directory", required=False, type=click.Path(path_type=Path), metavar="[DIR]")
@json_option
def list_sessions(directory: Path | None, *, as_json: bool) -> None:
    """List the sessions in DIR: start, state, length, size, lost messages, stops, marks and cars.

    By default, DIR is that of the fleet file here, or `sessions`. A stop of several cars counts
    once, whoever asked for it. The list also shows damaged sessions, and what is damaged, as far as their indexes tell.
    Only `fleet sessions verify` finds all damage.
    """
    _show(_summaries(directory), as_json=as_json)
    if not as_json:
        _say_removed(directory or sessions_place())


def _say_removed(place: Path) -> None:
    """Say which sessions a quota has removed from a directory."""
    if removed := removed_sessions(place):
        times = [str(each.get(name, "")) for each in removed for name in ("from", "to")]
        many = "1 session is" if len(removed) == 1 else f"{len(removed)} sessions are"
        span = f"{of_iso(min(times))} to {of_iso(max(times))}"
        echo_safely(f"{many} gone: removed by the quota, {span}. {place / REMOVED_FILE} lists them", err=True)


@sessions.command(
    epilog="\b\nexamples:\n  fleet sessions at 14:05\n  fleet sessions at 'yesterday 14:05' /media/disk/sessions\n\n"
    "Exit codes: 0 a session ran then, 1 none did, 2 wrong use."
)
@click.argument("time_text", metavar="TIME")
@click.argument("directory", required=False, type=click.Path(path_type=Path), metavar="[DIR]")
@json_option
def at(time_text: str, directory: Path | None, *, as_json: bool) -> None:
    """List the sessions that ran at TIME: a local time of day (14:05, on any day), `yesterday 14:05`, or a day."""
    now_s = time.time()
    try:
        time_spec.is_within(time_text, 0, 0, now_s)  # rejects an invalid time even if there is no session
        ran = [one for one in _summaries(directory) if time_spec.is_within(time_text, one.start_ns, one.end_ns, now_s)]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    if not ran:
        place = "" if directory is None else f" {shlex.quote(str(directory))}"
        raise click.ClickException(
            f"No session ran at {time_text}. `fleet sessions{place}` lists all, with their start."
        )
    _show(ran, as_json=as_json)
    echo_safely(f"Open one at that time: `fleet replay {ran[-1].typed} --from {shlex.quote(time_text)}`", err=True)


def _summaries(directory: Path | None) -> list["SessionSummary"]:
    from fleet.recording.tools.summary import overviews

    place = directory or sessions_place()
    try:
        found = list(overviews(place))
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        if not is_missing or directory is not None:
            why = f"There is no directory {place}." if is_missing else f"{place} cannot be listed: {error.strerror}."
            raise click.ClickException(f"{why} `fleet sessions` without DIR lists the sessions here.") from None
        found = []
    if not found:
        words = f"No recordings here yet (in {place}). `fleet up` records in the directory where it is typed."
        click.echo(words, err=True)
    return found


def _show(found: list["SessionSummary"], *, as_json: bool) -> None:
    if as_json:
        for one in found:
            click.echo(json.dumps(one.to_dict()))
        return
    if not found:
        return
    for line in aligned([_COLUMNS, *map(_row, found)]):
        echo_safely(line)
    for one in found:
        if one.words:
            echo_safely(f"{one.name}: {one.words}", err=True)


def _row(one: "SessionSummary") -> tuple[str, ...]:
    cars = ",".join(map(printable, one.cars[:5])) + (f" and {len(one.cars) - 5} more" if len(one.cars) > 5 else "")
    marks = str(len(one.marks)) + (" kept" if one.kept else "")
    marks += f", {len(one.pins)} pinned" if one.pins else ""
    length = time_spec.words(one.length_s)
    start = date_and_clock(one.start_ns / 1e9) if one.messages else "-"
    stops = "-" if one.stops is None else str(one.stops)
    return one.name, start, one.state, length, _size(one.bytes), str(one.messages), str(one.lost), stops, marks, cars


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


@sessions.command(
    epilog="\b\nexample:\n  fleet sessions info\n\nExit codes: 0 it could be read, 1 no message could be read."
)
@session_argument
@json_option
def info(session: Path, *, as_json: bool) -> None:
    """Show what is in a session: versions, cars, keys with their rates, marks, lost messages."""
    from fleet.recording.tools.merge_cut_recover import origin_words
    from fleet.recording.tools.summary import SessionState, marks_of, of_session, stops_of

    with _session_errors():
        found = _open(session)
        about = of_session(found)
        about.marks = marks_of(found, about)
        about.stops = stops_of(found, about)
        description = found.description
        is_unreadable = not about.messages and about.state in (
            SessionState.CUT,
            SessionState.DAMAGED,
            SessionState.GAPS,
        )
    origin = description.origin if description is not None else {}
    if as_json:
        more = {"versions": dict(description.versions), "host": description.host} if description is not None else {}
        click.echo(json.dumps({**about.to_dict(), **more, "origin": origin}))
        raise SystemExit(1 if is_unreadable else 0)
    echo_safely(f"{about.name}: {about.state}{f' ({about.words})' if about.words else ''}")
    if description is not None:
        versions = ", ".join(f"{name} {version}" for name, version in description.versions.items())
        echo_safely(f"  fleet {description.fleet}, recorded on {description.host or 'an unknown host'}; {versions}")
    if made := origin_words(origin):
        echo_safely(f"  made by {made}")
    _say_contents(about)
    raise SystemExit(1 if is_unreadable else 0)


def _say_contents(about: "SessionSummary") -> None:
    size = f"{about.messages} messages, {_size(about.bytes)}"
    began = of_iso(about.started) or "an unknown time"
    click.echo(f"  from {began}, {time_spec.words(about.length_s)}: {size}, {about.lost} lost")
    if about.clock_back_s:
        click.echo(
            f"  the recorder's clock went back by {about.clock_back_s:.1f} s: the length counts the time before and "
            "after that step"
        )
    click.echo(f"  cars: {', '.join(map(printable, about.cars)) or 'none'}; stops: {about.stops}")
    for mark in about.marks:
        by = name_of(mark.get("by") or "") or "somebody"
        echo_safely(f"  mark: {of_iso(mark.get('time', ''))} {mark.get('text', '')!r} by {by}")
    for pin in about.pins:
        times = f"{of_iso(pin.get('from', ''))} to {of_iso(pin.get('to', ''))}"
        cars = ", ".join(map(str, pin.get("cars", ())))
        echo_safely(f"  pinned: {times}: {pin.get('cause')}: {pin.get('words')}{f' ({cars})' if cars else ''}")
    for each in about.gone:
        times = f"{of_iso(each['from'])} to {of_iso(each['to'])}"
        pinned = ", pinned" if each.get("pinned") else ""
        echo_safely(f"  removed by the quota: {times}, {each['file']}{pinned}")
    shown = {key: printable(key) for key in about.keys}
    width = max(map(len, shown.values()), default=0)
    for key, count in about.keys.items():
        rate = f"  {count / about.length_s:7.2f} Hz" if about.length_s else ""
        click.echo(f"  {shown[key].ljust(width)}  {count:8}{rate}")


@sessions.command(epilog="\b\nexample:\n  fleet sessions verify\n\nExit codes: 0 it is whole, 1 it is not.")
@session_argument
@json_option
def verify(session: Path, *, as_json: bool) -> None:
    """Check a recording: checksums, missing messages, schemas, clocks.

    The command says what is missing. With --json, it lists every gap.
    """
    from fleet.recording.tools.summary import growth_check, total
    from fleet.recording.tools.verify import verify as verify_session

    with _session_errors():
        found = _open(session)
        verdict = verify_session(found, with_progress("verify", total(found)), growth_check(found))
    if as_json:
        click.echo(json.dumps(verdict.to_dict()))
    else:
        for line in verdict.words():
            echo_safely(line)
    raise SystemExit(0 if verdict.whole else 1)


@sessions.command(epilog="\b\nexample:\n  fleet sessions recover --out rescued\n")
@session_argument
@out_option
def recover(session: Path, out: Path | None) -> None:
    """Repair a damaged recording: copy everything readable into a new session."""
    from fleet.recording.tools import merge_cut_recover
    from fleet.recording.tools.summary import total

    with _session_errors():
        found = _open(session)
    out = out or found.path.resolve().with_name(f"{found.name}-recovered")
    with _session_errors(out):
        count, words = merge_cut_recover.recover(found, out, with_progress("recover", total(found)))
    echo_safely(f"{out}: {count} messages{f'; lost: {words}' if words else ', no message was damaged'}")


@sessions.command(
    epilog="""\b
example:
  fleet sessions merge latest latest~1 --out both
""",
)
@click.argument("several", nargs=-1, required=True, type=SessionPath(), metavar="SESSION SESSION...")
@required_out_option
def merge(several: tuple[Path, ...], out: Path) -> None:
    """Merge sessions that several recorders of one fleet recorded at the same time, for example at two sites.

    A message that several recorders received is written once, unless its publisher did not number it. The recorders'
    clocks decide the order of the messages.
    """
    from fleet.recording.tools import merge_cut_recover

    if len({each.resolve() for each in several}) < 2:
        raise click.UsageError("name several sessions: fleet sessions merge ONE OTHER --out DIR")
    with _session_errors():
        found = [_open(each) for each in several]
    with _session_errors(out):
        count, duplicates, lost = merge_cut_recover.merge(found, out, with_progress("merge", None))
    echo_safely(f"{out}: {count} messages; {duplicates} duplicates left out{f'; lost: {lost}' if lost else ''}")


@sessions.command(
    epilog="""\b
examples:
  fleet sessions cut --from 30s --to -10s --out part
  fleet sessions cut --car red,blue --out part
""",
)
@session_argument
@from_option
@to_option
@car_option
@required_out_option
def cut(session: Path, start: str | None, end: str | None, cars: tuple[str, ...], out: Path) -> None:
    """Copy a part of a session into a new session."""
    from fleet.recording.tools import merge_cut_recover

    with _session_errors():
        found = _open(session)
        selection = part_of(found, start, end, cars)
    with _session_errors(out):
        count = merge_cut_recover.cut(found, out, selection, cars, with_progress("cut", None))
    echo_safely(f"{out}: {count} messages{f'; {found.damage_words}' if found.damage else ''}")


@sessions.command(
    epilog="\b\nexamples:\n  fleet sessions export --csv tables\n  fleet sessions export --parquet tables\n"
    "  fleet sessions export --ros2 bag\n  fleet sessions export --foxglove foxglove\n",
)
@session_argument
@click.option("--csv", "csv", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Write CSV to DIR.")
@click.option(
    "--parquet",
    "parquet",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write Parquet to DIR.",
)
@click.option(
    "--ros2", "ros2", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Write a ROS 2 bag to DIR."
)
@click.option(
    "--foxglove",
    "foxglove",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write to DIR one MCAP file with one schema per topic, and a layout for its cars.",
)
@click.option("--nanoseconds", is_flag=True, help="Write the times in Parquet in nanoseconds (default: microseconds).")
def export(
    session: Path,
    csv: Path | None,
    parquet: Path | None,
    ros2: Path | None,
    foxglove: Path | None,
    *,
    nanoseconds: bool,
) -> None:
    """Write a session to a new directory: as tidy tables, as a ROS 2 bag, or as a file for Foxglove.

    There is one table for each type of message. Its columns are key, car, log_time, publish_time, sequence, then the
    fields. Times are UTC; Parquet has them in microseconds. The names of columns contain the units. In Parquet, the
    units are also in the metadata of the fields. Messages that are not protobuf, or do not fit their schema, are in the
    table `other`. A bag contains only standard messages (docs/how-to/look-at-a-recording.md).
    """
    from fleet.commands.session_export import export_foxglove, export_ros2, export_tables

    places = [each for each in (csv, parquet, ros2, foxglove) if each is not None]
    if not places or len(set(places)) < len(places):
        raise click.UsageError(
            "say in which format, and where to: --csv, --parquet, --ros2 or --foxglove, each with its own DIR"
        )
    if nanoseconds and parquet is None:
        raise click.UsageError(
            "--nanoseconds applies only to Parquet (CSV always has nanoseconds): also give --parquet DIR"
        )
    if csv is not None:
        with _session_errors(csv):
            export_tables(_open(session), csv, "csv")
    if parquet is not None:
        with _session_errors(parquet):
            export_tables(_open(session), parquet, "parquet", nanoseconds=nanoseconds)
    if ros2 is not None:
        with _session_errors(ros2):
            export_ros2(_open(session), ros2)
    if foxglove is not None:
        with _session_errors(foxglove):
            export_foxglove(_open(session), foxglove)
