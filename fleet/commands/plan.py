"""`fleet why` and `fleet plan`: explains decisions of the coordinator, checks a plan and restarts it."""

import json
import time
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import click

from fleet.client.client import Fleet
from fleet.client.command_tracker import ANSWER_TIMEOUT_S
from fleet.client.reading import Reading
from fleet.commands.options import cli_errors, json_option, with_client
from fleet.coordinator.coordinator import RESTART_VERB
from schemas import keys, messages, topics
from schemas.bus import Failure


@click.command(
    epilog="""\b
examples:
  fleet why red
  fleet why              every car, role and phase
  fleet why patrol --json"""
)
@click.argument("subjects", nargs=-1, metavar="[CAR|ROLE|phase]...")
@json_option
@with_client
def why(client: Fleet, subjects: tuple[str, ...], *, as_json: bool) -> None:
    """Explain the coordinator's last decision on a car or role: reason, readings, and what would change it."""
    key = f"{client.name}/{keys.COORDINATOR}/decision"
    found = {reading.value.subject: reading for reading in client.get(key)}
    if not found and not client.bus.tokens(f"{client.name}/{keys.COORDINATOR}"):
        raise click.ClickException(
            f"no coordinator answers in fleet {client.name}: start one (fleet coordinate --plan FILE)"
        )
    for subject in subjects or sorted(found):
        reading = found.get(subject) or found.get(f"role {subject}")
        if reading is None:
            there = ", ".join(name.removeprefix("role ") for name in sorted(found)) or "nothing"
            raise click.ClickException(f"nothing was decided of {subject}; there are decisions of {there}")
        click.echo(json.dumps(reading.as_dict()) if as_json else _describe(reading))


def _describe(reading: Reading) -> str:
    decision = reading.value
    since_s = decision.since.seconds + decision.since.nanos / 1e9
    at = datetime.fromtimestamp(since_s).astimezone().strftime("%H:%M:%S")
    lasting = timedelta(seconds=max(0, int(time.time() - since_s)))
    lines = [f"{decision.subject}: {decision.decided}, for {lasting} (since {at})"]
    lines.append(f"  because:   {decision.why}")
    lines += [f"  with       {each}" for each in decision.readings]
    lines.append(f"  changes by {decision.would_change}")
    return "\n".join(lines)


@click.group(epilog="\b\nexamples:\n  fleet plan check plan.yaml --fleet-file fleet.yaml\n  fleet plan restart")
def plan() -> None:
    """Check a plan, or restart the plan in force."""


@plan.command(
    epilog="""\b
example:
  fleet plan check plan.yaml --fleet-file fleet.yaml

Exit codes: 0 nothing that can never work, 1 something, 2 no plan."""
)
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--fleet-file",
    "--fleet",
    "fleet_file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The fleet file: its cars, platforms and roles; without one, cars of any platform.",
)
@json_option
def check(file: Path, fleet_file: Path | None, *, as_json: bool) -> None:
    """Find roles that no car can fill, rules that never fire or contradict each other, and unreachable phases."""
    from fleet.coordinator.observer import listed_cars
    from fleet.fleetfile.fleet_file import read_fleet
    from fleet.policy.plan.lint import Severity
    from fleet.policy.plan.lint import check as check_plan
    from fleet.policy.plan.parser import parse
    from schemas.yaml_document.document import read_text

    with cli_errors():
        read = parse(read_text(file), str(file))
        cars = None if fleet_file is None else listed_cars(read_fleet(fleet_file))
    findings = check_plan(read, cars)
    errors = [each for each in findings if each.severity is Severity.ERROR]
    for each in findings:
        if as_json:
            click.echo(
                json.dumps(
                    {
                        "gravity": each.severity,
                        "line": each.line,
                        "column": each.column,
                        "part": each.part,
                        "words": each.words,
                    }
                )
            )
        else:
            click.echo(each.at(str(file)))
    if errors:
        raise SystemExit(1)
    if not as_json:
        what = f"{len(read.roles)} roles, {len(read.rules)} rules, {len(read.phases)} phases"
        click.echo(f"{file}: {what}: nothing that can never work")


@plan.command(
    epilog="""\b
example:
  fleet plan restart"""
)
@json_option
@with_client
def restart(client: Fleet, *, as_json: bool) -> None:
    """Restart the plan in force: its first phase, no rule in force. Cars keep the roles that they still fit."""
    key = keys.command_key(client.name, keys.COORDINATOR, RESTART_VERB)
    for answer in client.bus.query(key, timeout_s=ANSWER_TIMEOUT_S):
        if isinstance(answer, Failure):
            raise click.ClickException(answer.words)
        result: Any = messages.parse(topics.RESULT, answer.payload, answer.encoding)
        click.echo(json.dumps({"status": result.status, "words": result.words}) if as_json else result.words)
        return
    raise click.ClickException(
        f"no coordinator answers in fleet {client.name}: start one (fleet up, fleet coordinate --plan FILE)"
    )
