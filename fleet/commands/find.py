"""`fleet find`: searches all sessions for the times at which a condition held."""

import json
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import click

from fleet.client.client import default_sender
from fleet.commands.car_names import car_option
from fleet.commands.command_group import chosen_person
from fleet.commands.exit_code import cli_errors
from fleet.commands.options import json_option
from fleet.commands.output import MAX_CELL, aligned, echo_csv, echo_safely
from fleet.commands.params import Duration, existing_sessions_place
from fleet.console import DEFAULT_PORT
from fleet.policy.car_condition import parse_condition
from fleet.recording import time_spec
from fleet.recording.session_dir import MAX_MARK_CHARACTERS, NoMark, add_mark
from fleet.recording.session_lookup import sessions_in
from schemas import keys
from schemas.local_time import date_and_clock, with_offset
from schemas.printable import printable

if TYPE_CHECKING:
    from fleet.conditions import Expression
    from fleet.recording.tools.condition_search import Found, Hit

MAX_FOR_S: Final = 86_400.0
"""Maximum of --for. Recordings of lessons and demos are not longer than a day."""
FIELDS: Final = ("session", "path", "car", "from", "to", "length_s", "mode", "command", "open", "link")
"""Fields of a hit as JSON and CSV."""
_COLUMNS: Final = ("session", "car", "from", "to", "length", "mode", "last command")


@click.command(
    epilog="""\b
examples:
  fleet find 'range_m < 0.3'
  fleet find 'not (line.left_inner or line.right_inner)' --car red --for 2s --since monday
  fleet find 'range_m < 0.1' --mark --csv > near.csv
  fleet find "mode.verdict == 'contradicted'" /media/disk/sessions --json

Exit codes: 0 there is a hit, 1 there is none, or a session with a hit could not be marked, 2 wrong use."""
)
@click.argument("condition", metavar="CONDITION")
@click.argument("directory", required=False, type=click.Path(path_type=Path), metavar="[DIR]")
@car_option
@click.option(
    "--for", "for_s", type=Duration(MAX_FOR_S), default=None, help="Print a hit only if it lasted at least this long."
)
@click.option(
    "--since", metavar="TIME", help="Search from TIME on: monday, yesterday 14:05, 14:05, a date, or 1h (one hour ago)."
)
@click.option("--mark", is_flag=True, help="Mark each closed session that has a hit, at its first hit.")
@click.option("--csv", "as_csv", is_flag=True, help="Write CSV, with times in UTC.")
@json_option
def find(
    condition: str,
    directory: Path | None,
    cars: tuple[str, ...],
    for_s: float | None,
    since: str | None,
    *,
    mark: bool,
    as_csv: bool,
    as_json: bool,
) -> None:
    """Find when CONDITION held, in every session in DIR (default: sessions, else as in the fleet file here).

    CONDITION is written as in plans: range_m < 0.3, with and, or, not. A value that was not measured, or is stale, is
    unknown. A hit lasts from the first reading for which CONDITION is true to the last one. A session that
    --mark has marked is kept when `fleet record --quota` makes room.
    """
    if as_csv and as_json:
        raise click.UsageError("give --csv or --json, not both")
    with cli_errors():
        expression = parse_condition(condition)
    try:
        since_ns = 0 if since is None else time_spec.past_ns(since, time.time())
    except ValueError as error:
        raise click.UsageError(f"--since: {error}") from None
    place = existing_sessions_place(directory)
    answers = list(_search(place, expression, cars, for_s or 0.0, since_ns))
    found = [(path, hit) for path, answer in answers for hit in answer.hits]
    if as_json:
        for path, hit in found:
            click.echo(json.dumps(_to_dict(path, hit)))
    elif as_csv:
        echo_csv(FIELDS, [list(_to_dict(path, hit).values()) for path, hit in found])
    elif found:
        header, *lines = aligned([_COLUMNS, *(_row(path, hit) for path, hit in found)])
        echo_safely(header)
        for line, (path, hit) in zip(lines, found, strict=True):
            echo_safely(f"{line}\n  {_open_command(path, hit)}")
    if mark and not _mark_sessions(found, expression):
        raise click.exceptions.Exit(1)
    if not found:
        most_s = max((answer.longest_s for _, answer in answers), default=-1.0)
        how_long = ""
        if most_s >= 0:
            how_long = f" for {time_spec.words(for_s or 0.0)}, but for {time_spec.words(most_s)} at most,"
        after = f" since {since}" if since is not None else ""
        raise click.ClickException(f"{expression} was never true{how_long} in the sessions in {place}{after}.")


def _search(
    place: Path, expression: "Expression", cars: tuple[str, ...], for_s: float, since_ns: int
) -> Iterator[tuple[Path, "Found"]]:
    """Search the sessions. Yield each with its hits, and print on stderr what could not be searched."""
    from fleet.recording.reading.session import NoSession, Session
    from fleet.recording.tools.condition_search import find_in
    from fleet.recording.tools.summary import of_session

    try:
        paths = sorted(sessions_in(place))
    except OSError as error:
        raise click.ClickException(f"{place} cannot be listed: {error.strerror}.") from None
    there: set[str] = set()
    for path in paths:
        try:
            session = Session(path)
        except NoSession as error:
            echo_safely(f"{path.name}: {error}", err=True)
            continue
        about = of_session(session)
        there |= {*about.cars}
        if is_searched := about.end_ns >= since_ns:
            searched = [car for car in about.cars if not cars or car in cars]
            found = find_in(session, expression, searched, for_s, since_ns)
            yield path, found
            for words in found.left_out.words():
                echo_safely(f"{path.name}: not searched: {words}", err=True)
        # A file that cannot be read may be newer than `since_ns`, so report it even if the session was not searched.
        if words := session.damage_words or (about.words if is_searched else ""):
            echo_safely(f"{path.name}: only what is intact was searched: {words}", err=True)
    if there and (missing := sorted({*cars} - there)):
        raise click.UsageError(f"--car: no session has {', '.join(missing)}: there are {', '.join(sorted(there))}")


def _mark_sessions(found: list[tuple[Path, "Hit"]], expression: "Expression") -> bool:
    """Mark the first hit of each session. If a session cannot be marked, name it on stderr and return False."""
    hits: dict[Path, list[Hit]] = {}
    for path, hit in found:
        hits.setdefault(path, []).append(hit)
    are_marked = True
    for path, hits_here in hits.items():
        count = "1 hit" if len(hits_here) == 1 else f"{len(hits_here)} hits"
        text = f"{expression}: {hits_here[0].car}, {count}"[:MAX_MARK_CHARACTERS]
        try:
            # The author is only the person, without host and process. So the same search recognizes its mark tomorrow.
            add_mark(path, hits_here[0].begin_ns, text, keys.person_of(default_sender(chosen_person())))
        except (NoMark, OSError) as error:
            words = error.strerror if isinstance(error, OSError) else error
            echo_safely(f"{path.name}: not marked: {words}", err=True)
            are_marked = False
    return are_marked


def _row(path: Path, hit: "Hit") -> tuple[str, ...]:
    times = (date_and_clock(hit.begin_ns / 1e9), date_and_clock(hit.end_ns / 1e9))
    return (
        printable(path.name, MAX_CELL),
        printable(hit.car, MAX_CELL),
        *times,
        time_spec.words(hit.length_s),
        *(printable(each, MAX_CELL) or "-" for each in (hit.mode, hit.command)),
    )


def _to_dict(path: Path, hit: "Hit") -> dict[str, object]:
    times = (time_spec.iso(hit.begin_ns), time_spec.iso(hit.end_ns), round(hit.length_s, 3))
    opens = (_open_command(path, hit), _link(path, hit))
    values = (path.name, str(path), hit.car, *times, hit.mode or None, hit.command or None, *opens)
    return dict(zip(FIELDS, values, strict=True))


def _link(path: Path, hit: "Hit") -> str:
    """Return the address at which a running `fleet console` with its default port shows the hit on the time line."""
    at = time_spec.iso(hit.begin_ns)
    return f"http://127.0.0.1:{DEFAULT_PORT}/#/time?session={quote(path.name, safe='')}&at={at}"


def _open_command(path: Path, hit: "Hit") -> str:
    """Return a command that a person may paste. Leave out a recorded name that no car can have: it may be an attack."""
    place = str(path) if not str(path).startswith("-") else f"./{path}"
    car = f" --car {hit.car}" if keys.is_name(hit.car) else ""
    return f"fleet replay {shlex.quote(place)}{car} --from {with_offset(hit.begin_ns)}"
