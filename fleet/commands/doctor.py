"""`fleet doctor`: shows the state of an odd car or session to an engineer, and names the likely cause."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import click

from fleet.client.car_evidence import collect
from fleet.client.diagnosis import CarEvidence, DoctorFinding, as_dict, describe, diagnose
from fleet.client.refused_by_hub import why_refused
from fleet.commands.car_names import complete_car, no_cars
from fleet.commands.command_group import hint_options, say
from fleet.commands.options import bus_options, json_option
from fleet.commands.output import echo_safely, with_progress
from fleet.commands.params import SessionPath
from fleet.commands.which_fleet import open_client
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.session_dir import is_session
from fleet.recording.tools.session_findings import SessionCheckup
from fleet.recording.tools.summary import growth_check, total, typed_name
from fleet.recording.tools.verify import verify
from schemas.suggestion import did_you_mean

MAX_STOP_LINES: Final = 20
"""Maximum number of stops that cars did not show, as printed, one per line. --json lists all."""
MAX_FURTHER_FINDINGS: Final = 3
"""Maximum number of findings on the line after the likely cause."""


@click.command(
    epilog="""\b
examples:
  fleet doctor
  fleet doctor red
  fleet doctor latest
  fleet doctor latest red     # why did red not stop

The first line is the likely cause and what to type.

Exit codes: 0 nothing is odd, 1 something is odd."""
)
@click.argument("name", required=False, metavar="[CAR | SESSION]", shell_complete=complete_car)
@click.argument("car", required=False, metavar="[CAR]")
@json_option
@bus_options
def doctor(name: str | None, car: str | None, connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Say in ten lines why a car behaves oddly, or what is wrong with a session. Without a name, look at all cars.

    For a session, the command lists each stop that was not shown or did not stop its car: car, time and cause.
    """
    if name is not None and (session := _session_of(name)) is not None:
        _show_session(session, car or "", as_json=as_json)
    if car is not None:
        raise click.UsageError(
            f'"{name}" is not a session. Two names are a session and a car: fleet doctor SESSION CAR'
        )
    named = (name,) if name is not None else ()
    with open_client(connect, fleet, named) as client:
        found = collect(client)
        if not found:
            raise no_cars(client)
        if not any(each.state.present for each in found.values()) and (refused := why_refused(client)):
            raise click.ClickException(refused)
        if name is not None and name not in found:
            near = did_you_mean(name, found) or f"Cars: {', '.join(found)}."
            raise click.ClickException(f'No car or session "{name}". {near}')
    cars = list(found.values()) if name is None else [found[name]]
    odd = [diagnose(evidence, hint_options()) for evidence in cars]
    if name is None and not as_json:
        # Findings about the whole fleet come first, so that no finding about a car hides them.
        for finding in dict.fromkeys(each for findings in odd for each in findings if each.of_fleet):
            echo_safely(f"{fleet}: {finding}")
    for evidence, findings in zip(cars, odd, strict=True):
        if as_json:
            click.echo(json.dumps(as_dict(evidence, hint_options())))
        elif name is None:
            echo_safely(_first_line(evidence.state.car, [each for each in findings if not each.of_fleet]))
        else:
            _show_car(evidence, findings)
    raise SystemExit(1 if any(odd) else 0)


def _session_of(name: str) -> Path | None:
    """Return the path of the session with this name, or None if there is no such session."""
    path = SessionPath().convert(name, None, click.get_current_context())
    return path if is_session(path) else None


def _show_car(evidence: CarEvidence, findings: Sequence[DoctorFinding]) -> None:
    echo_safely(_first_line(evidence.state.car, findings))
    _show(findings, describe(evidence))


def _show_session(path: Path, car: str, *, as_json: bool) -> None:
    """Print what is known about a session, and exit. If `car` is empty, look at all its cars."""
    try:
        session = Session(path)
    except NoSession as error:
        raise click.ClickException(str(error)) from None
    checkup, progress = SessionCheckup(car=car), with_progress("doctor", total(session))
    verdict = verify(session, lambda rows: checkup.watch(progress(rows)), growth_check(session))
    if car and car not in checkup.cars:
        near = did_you_mean(car, checkup.cars) or f"Cars: {', '.join(sorted(checkup.cars))}."
        raise click.ClickException(f'No car "{car}" in {session.name}. {near}')
    name = typed_name(session)
    findings = list(checkup.findings(verdict, name))
    if as_json:
        click.echo(json.dumps(checkup.as_dict(verdict, name)))
    else:
        echo_safely(_first_line(session.name, findings))
        _show(findings, checkup.facts(verdict))
        stops = checkup.unshown.stops
        for stop in stops[:MAX_STOP_LINES]:
            echo_safely(f"  {stop.describe()}")
        if len(stops) > MAX_STOP_LINES:
            click.echo(f"  and {len(stops) - MAX_STOP_LINES} more: --json lists all")
    raise SystemExit(1 if findings else 0)


def _first_line(name: str, findings: Sequence[DoctorFinding]) -> str:
    return f"{name}: {findings[0] if findings else 'Nothing odd was found.'}"


def _show(findings: Sequence[DoctorFinding], facts: Iterable[tuple[str, str]]) -> None:
    """Print the further findings on one line, then one line for each fact."""
    if further := findings[1 : 1 + MAX_FURTHER_FINDINGS]:
        click.echo(f"  also: {' '.join(map(str, further))}")
    for name, words in facts:
        say(f"  {name:11} {words}")
