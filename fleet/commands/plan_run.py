"""`fleet plan run`: runs the coordinator as a process."""

import json
import threading
from pathlib import Path

import click

from fleet.client.client import Fleet, default_sender
from fleet.commands.command_group import starter_option
from fleet.commands.options import bus_options, json_option
from fleet.coordinator.coordinator import Coordinator
from fleet.coordinator.observer import listed_cars
from fleet.coordinator.other_coordinators import SENDER, AnotherCoordinator
from fleet.fleetfile.fleet_file import people_table, read_fleet
from fleet.policy.decision import Decision
from fleet.policy.lint.lint import find_faults
from fleet.policy.plan.plan_parser import parse
from schemas.identity import Service, service
from schemas.process import signals
from schemas.process.parent import has_ended, watched_pid
from schemas.words import Rank
from schemas.yaml_document.document import read_text


@click.command(
    epilog="""\b
example:
  fleet plan run plan.yaml

`fleet up --plan FILE` runs a plan together with the fleet. This command runs only a coordinator.

\b
a plan:
  roles:
    patrol: {mode: obstacle_avoidance, needs: battery_v > 7.0, count: 2}
  fixed:
    blue: {mode: manual}
  rules:
    - when: {car: red, is: range_m < 0.3, for_s: 0.5}
      then: {who: blue, mode: tracking}"""
)
@click.argument("path", metavar="FILE", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--fleet-file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Read the cars and the people from this fleet file.",
)
@click.option(
    "--run",
    "run_name",
    default="",
    metavar="NAME",
    help="Name of the run of `fleet up`. A coordinator that starts again under this name goes on in the same phase.",
)
@starter_option()
@json_option
@bus_options
def run(
    path: Path,
    fleet_file: Path | None,
    run_name: str,
    connect: str | None,
    fleet: str,
    *,
    starter: int | None,
    as_json: bool,
) -> None:
    """Run a plan until Ctrl-C, and print one line per decision. The plan does not move a car that you have stopped.

    After Ctrl-C, the command stops the cars of the plan and waits until they stand. A second Ctrl-C ends the wait. The
    exit code is 1 if one of them may still be moving.
    """
    parent = watched_pid(starter)
    plan = parse(read_text(path), str(path))
    file = None if fleet_file is None else read_fleet(fleet_file, unbound=True)
    listed = {} if file is None else listed_cars(file)
    found = find_faults(plan, listed or None)
    found.raise_errors(str(path))
    for each in found.warnings:
        click.echo(each.at(str(path)), err=True)
    stop, stop_waiting = threading.Event(), threading.Event()

    def end() -> None:
        (stop_waiting if stop.is_set() else stop).set()

    signals.calls(end)

    def on_decided(decision: Decision) -> None:
        click.echo(_json(decision) if as_json else decision_line(decision))

    with Fleet(
        connect,
        fleet,
        sender=f"{SENDER}{default_sender()}",
        kind=Rank.COORDINATOR,
        start_hub=True,
        identity=service(Service.COORDINATOR),
    ) as client:
        try:
            may_move = Coordinator(
                client,
                plan,
                on_decided,
                lambda words: click.echo(f"fleet: {words}", err=True),
                listed,
                None if file is None else people_table(file.people),
                run_name,
            ).run(lambda: stop.is_set() or has_ended(parent), stop_waiting.is_set)
        except AnotherCoordinator as error:
            raise click.ClickException(str(error)) from None
    raise SystemExit(1 if may_move else 0)


def decision_line(decision: Decision) -> str:
    """Return a decision as text for a person."""
    readings = f" ({', '.join(decision.readings)})" if decision.readings else ""
    return (
        f"{decision.subject}: {decision.decided}, because: {decision.why}{readings}; "
        f"would change if: {decision.would_change}"
    )


def _json(decision: Decision) -> str:
    names = ("subject", "kind", "decided", "car", "role", "mode", "why", "readings", "would_change")
    return json.dumps({name: getattr(decision, name) for name in names})
