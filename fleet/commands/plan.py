"""`fleet why` and `fleet plan`: the plan in force, what it decides and why, and requests for it."""

import importlib
import json
import re
import time
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Final

import click

from fleet.client.car_state import CarState
from fleet.client.claims import CarClaim
from fleet.client.client import Fleet
from fleet.client.diagnosis import describe_people
from fleet.client.reading import Reading
from fleet.client.services import NO_PLAN, ask_coordinator
from fleet.client.supervision import describe_silent_coordinator
from fleet.commands.car_names import complete_car
from fleet.commands.command_group import CommandGroup, say
from fleet.commands.exit_code import WrongFile
from fleet.commands.options import bus_options, json_option, with_client
from fleet.commands.params import SessionPath
from fleet.commands.which_fleet import open_client
from fleet.policy.plan_requests import PlanRequest
from schemas import keys
from schemas.bus import Failure
from schemas.local_time import clock
from schemas.suggestion import did_you_mean
from schemas.words import Phase, Reason, RunState

_OWN_MODULES: Final = {"run": "fleet.commands.plan_run:run", "try": "fleet.commands.plan_try:try_plan"}
"""Subcommands whose imports would slow down all others."""
_NOBODY: Final = "nobody has stopped, borrowed or drives it"


@click.command(
    epilog="""\b
examples:
  fleet why red
  fleet why              # every car, role and phase
  fleet why patrol --json
  fleet why red --session latest --at 14:05   # why did red not stop then"""
)
@click.argument("subjects", nargs=-1, metavar="[CAR|ROLE|phase]...", shell_complete=complete_car)
@click.option("--session", type=SessionPath(), help="Explain a car in this recording, at the time of --at.")
@click.option(
    "--at",
    "at",
    metavar="TIME",
    help="Explain this moment: a local time of day (14:05, 14:05:12), or a time in the session.",
)
@json_option
@bus_options
def why(
    subjects: tuple[str, ...], session: Path | None, at: str | None, connect: str | None, fleet: str, *, as_json: bool
) -> None:
    """Explain why a car does what it does: what the plan decided, from which readings, and what would change that.

    Also say who stopped, paused, borrowed or drives the car, since when, and what ends that. With --session and --at,
    say what happened to one car around that time of a recording, and why a stop was not shown.
    """
    if session is not None or at is not None:
        from fleet.commands.why_session import explain_session

        if session is None or at is None or len(subjects) != 1:
            raise click.UsageError(
                "to explain a moment of a recording, give one car, --session and --at: "
                "fleet why red --session latest --at 14:05"
            )
        explain_session(subjects[0], session, at, as_json=as_json)
        return
    with open_client(connect, fleet, subjects) as client:
        _explain_now(client, subjects, as_json=as_json)


def _explain_now(client: Fleet, subjects: tuple[str, ...], *, as_json: bool) -> None:
    key = f"{client.name}/{keys.COORDINATOR}/decision"
    found = {reading.value.subject: reading for reading in client.get(key)}
    people, motors = _people(client, subjects)
    if not found and not client.get(f"{client.name}/{keys.COORDINATOR}/plan"):
        why = describe_silent_coordinator(client.bus, client.name)
        if not (subjects or people) or any(car not in motors for car in subjects):
            raise click.ClickException(_no_plan(client))
        end = "" if why else " No plan is running."
        for car in subjects or people:
            words = "; ".join(people.get(car, [_NOBODY, f"motors {motors[car].words}"]))
            say(json.dumps({"car": car, "words": words}) if as_json else f"{car}: {words}.{end}")
        if why:
            raise click.ClickException(f"{why}.")
        return
    if not found and not subjects:
        click.echo("The coordinator has not decided anything yet: repeat this in a second.", err=True)
    for subject in subjects or sorted(found):
        reading = found.get(subject) or found.get(f"role {subject}")
        if reading is None:
            names = [name.removeprefix("role ") for name in sorted(found)]
            near = did_you_mean(subject, names) or f"There are decisions about: {', '.join(names) or 'nothing yet'}."
            raise click.ClickException(f"No decision about {subject}. {near}")
        deeds, claim = people.get(subject, []), motors.get(subject)
        if as_json:
            claimed = None if claim is None else claim.as_dict()
            click.echo(json.dumps(reading.as_dict() | {"people": deeds, "motors": claimed}))
        else:
            say(_describe(reading, deeds, claim))


def _no_plan(client: Fleet) -> str:
    """Return a text that says that no plan is running, and names the command that starts one.

    It names `fleet up` only if no supervisor runs. If there is a coordinator that does not answer, the text says that.
    """
    if why := describe_silent_coordinator(client.bus, client.name):
        return f"{why}."
    is_up = bool(client.bus.tokens(keys.car_token(client.name, keys.SUPERVISOR)))
    other = "" if is_up else ", or a fleet with one: `fleet up --plan FILE`"
    return f"{NO_PLAN}{other}."


def _people(client: Fleet, cars: Sequence[str]) -> tuple[dict[str, list[str]], dict[str, CarClaim]]:
    """Return two maps by car: texts about who stopped, paused, borrowed or drives it, and the claim about its motors.

    The texts also say what ends that. Empty `cars` means all cars.
    """
    found, motors, now = {}, {}, time.time()
    for car in cars or ["*"]:
        for reading in client.get(f"{car}/state/safety") if car == "*" or keys.is_name(car) else ():
            state = CarState.of_answers(reading.car, [("state/safety", reading)], now, present=True)
            motors[reading.car] = state.claims(now).motors
            deeds = [f"{words}; `{todo}` ends it" for words, todo in describe_people(reading.car, reading.value)]
            if deeds:
                found[reading.car] = deeds
    return found, motors


def _describe(reading: Reading, people: Sequence[str], motors: CarClaim | None) -> str:
    decision = reading.value
    since_s = decision.since.seconds + decision.since.nanos / 1e9
    at = clock(since_s)
    lasting = timedelta(seconds=max(0, int(time.time() - since_s)))
    lines = [f"{decision.subject}: {decision.decided}, for {lasting} (since {at})", f"  because: {decision.why}"]
    if motors is not None:
        lines.append(f"  motors: {motors.words}")
    lines += [f"  person: {each}" for each in people]
    # Their ages are those at the time of the decision.
    lines += [f"  reading then: {each}" for each in decision.readings]
    lines += [f"  would change if: {each}" for each in decision.would_change.split("; or ")]
    return "\n".join(lines)


class _PlanGroup(CommandGroup):
    """A group that imports some of its commands when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*_LISTED_FIRST, *(each for each in super().list_commands(ctx) if each not in _LISTED_FIRST)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _OWN_MODULES:
            return super().get_command(ctx, cmd_name)
        module, _, name = _OWN_MODULES[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        return command


_LISTED_FIRST: Final = ("run", "set", "show", "try")


@click.group(
    cls=_PlanGroup,
    epilog="""\b
examples:
  fleet up --plan plan.yaml       # run a plan with a fleet
  fleet plan set other.yaml       # change it while it runs
  fleet plan stop                 # bring its cars to rest

`fleet check plan.yaml` looks for mistakes.""",
)
def plan() -> None:
    """Run, change, show and stop the plan: what the cars do together."""


@plan.command("set", epilog="\b\nexample:\n  fleet plan set plan.yaml")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@json_option
@bus_options
def set_plan(file: Path, *, as_json: bool, connect: str | None, fleet: str) -> None:
    """Put another plan in force. The plan is accepted as a whole, or rejected with all its errors.

    Roles, rules and the phase continue if both plans have them. A stopped plan runs again.
    """
    from fleet.policy.plan.plan_parser import parse
    from schemas.yaml_document.document import read_text

    text = read_text(file)
    parse(text, str(file))  # parse before sending, so that errors name the position in this file
    with open_client(connect, fleet) as client:
        _request(client, "plan", text, source=str(file), as_json=as_json)


@plan.command(epilog="\b\nexample:\n  fleet plan show --json")
@json_option
@with_client
def show(client: Fleet, *, as_json: bool) -> None:
    """Show the plan in force: its roles and the cars that have them, the phase, and the rules in force."""
    from fleet.policy.plan.plan_parser import parse

    place = f"{client.name}/{keys.COORDINATOR}"
    found = {reading.key.rpartition("/")[2]: reading.value for reading in client.get(f"{place}/*")}
    if "plan" not in found:
        raise click.ClickException(_no_plan(client))
    in_force, assignment = found["plan"], found.get("assignment")
    plan = parse(in_force.text, "the plan in force")
    cars = {role.name: list(role.cars) for role in assignment.roles} if assignment else {}
    rules = list(assignment.rules) if assignment else []
    phase, stopped_by = (assignment.phase, assignment.stopped_by) if assignment else ("", "")
    roles = {name: cars.get(name, []) for name in plan.roles}
    others = {name: them for name, them in cars.items() if name not in plan.roles}
    if as_json:
        whole = {"version": in_force.version, "set_by": in_force.set_by, "stopped_by": stopped_by, "phase": phase}
        whole |= {"phases": list(plan.phases), "roles": roles, "without_role": others, "rules_in_force": rules}
        click.echo(json.dumps(whole))
        return
    by = f", set by {keys.name_of(in_force.set_by)}" if in_force.set_by else ""
    state = (
        f"stopped by {keys.name_of(stopped_by)}. `fleet plan restart` starts it again"
        if stopped_by
        else RunState.RUNNING
    )
    say(f"Plan {in_force.version}{by}: {state}.")
    if plan.phases:
        click.echo(f"phase: {phase or '-'} (of {', '.join(plan.phases)})")
    for name, role in plan.roles.items():
        wanted = "" if role.count is None else f", {len(roles[name])} of {role.count}"
        click.echo(f"role {name} ({role.mode}): {', '.join(roles[name]) or 'no car'}{wanted}")
    for name, them in others.items():
        click.echo(f"{name}: {', '.join(them)}")
    if plan.rules:
        click.echo(f"rules in force: {', '.join(rules) or 'none'} (of {len(plan.rules)})")


@plan.command(epilog="\b\nexample:\n  fleet plan restart")
@json_option
@with_client
def restart(client: Fleet, *, as_json: bool) -> None:
    """Restart the plan in force with its first phase, and discard its state. This also ends `fleet plan stop`."""
    _request(client, PlanRequest.RESTART, as_json=as_json)


@plan.command("next", epilog="\b\nexample:\n  fleet plan next")
@json_option
@with_client
def next_phase(client: Fleet, *, as_json: bool) -> None:
    """Go on to the next phase of the plan now. This is refused if the plan has no phases, or is in its last phase."""
    _request(client, PlanRequest.NEXT, as_json=as_json)


@plan.command(epilog="\b\nexamples:\n  fleet plan stop\n  fleet plan restart")
@json_option
@with_client
def stop(client: Fleet, *, as_json: bool) -> None:
    """Stop the plan. The coordinator brings the cars that it commands to rest, and makes no more decisions.

    The cars get no hold, so anyone may drive them at once. Cars that a person has stopped or drives stay as they are.
    Continue with `fleet plan restart` or `fleet plan set`. While `fleet up` runs, a coordinator that restarts does not
    run the stopped plan again.
    """
    _request(client, PlanRequest.STOP, as_json=as_json)


def _request(client: Fleet, verb: str, plan_text: str = "", *, as_json: bool, source: str = "plan") -> None:
    """Send a request to the coordinator, and print its answer. Exit with code 1 if it refuses, 2 for a wrong plan."""
    result = ask_coordinator(client, verb, plan_text)
    if result is None:
        raise click.ClickException(_no_plan(client))
    if isinstance(result, Failure):
        raise click.ClickException(result.words)
    ok, wrong = result.status == Phase.SENT, result.reason == Reason.BAD_VALUE
    words = re.sub("^plan:", f"{source}:", result.words, flags=re.MULTILINE)
    if as_json:
        click.echo(json.dumps({"status": result.status, "reason": result.reason, "words": words}))
    elif ok:
        say(words)
    else:
        raise (WrongFile if wrong else click.ClickException)(words)
    raise SystemExit(0 if ok else 2 if wrong else 1)
