"""The exit code of a command: of its outcomes on the cars, which are printed here, and of its errors."""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Never

import click
from msgspec.structs import replace

from fleet.client.client import Fleet
from fleet.client.commands import CommandRequest
from fleet.client.hints import complete_hints
from fleet.client.hub_ended import describe_running, explain_no_fleet
from fleet.client.outcome import NO_ANSWER, Outcome
from fleet.client.refused_by_hub import why_refused
from fleet.commands.car_names import describe_other_fleets, no_cars, resolve_cars
from fleet.commands.command_group import hint_options, say
from schemas import keys
from schemas.bus import BadEndpoint, BusError, NoFleet, resolve_endpoint
from schemas.words import Reason


def carry_out(
    client: Fleet, request: CommandRequest, cars: Sequence[str], *, as_json: bool, take: bool = False
) -> None:
    """Send a command to the cars, print each outcome, and exit with the code of `end_with`."""
    end_with(client, client.ask(replace(request, take=take), resolve_cars(client, cars)), as_json=as_json)


def end_with(client: Fleet, outcomes: Sequence[Outcome], *, as_json: bool) -> Never:
    """Print each outcome. Exit with code 0 if all cars have obeyed, 2 if every failure is a bad value, 1 otherwise.

    Fail if there is no outcome, which means that no car is connected.
    """
    if not outcomes:
        raise no_cars(client)
    print_outcomes(outcomes, as_json=as_json)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    if all(outcome.phase == NO_ANSWER for outcome in outcomes):
        # --fleet may be wrong, or our certificate may have been revoked.
        words = describe_other_fleets(client)
        if not words and not client.cars():
            words = why_refused(client)
        if words:
            say(words, err=True)
    wrong = bool(failed) and all(outcome.reason == Reason.BAD_VALUE for outcome in failed)
    raise SystemExit(2 if wrong else 1 if failed else 0)


def print_outcomes(outcomes: Iterable[Outcome], *, as_json: bool) -> None:
    """Print one line for each car: failures to stderr, JSON always to stdout."""
    for outcome in outcomes:
        if as_json:
            click.echo(json.dumps(asdict(outcome)))
        else:
            say(str(outcome), err=not outcome.ok, fleet=outcome.car.rpartition("/")[0])


def not_running(fleet: str, connect: str | None) -> click.ClickException:
    """Return the error that no supervisor answers.

    It warns if gateways run nevertheless, because their cars may move.
    """
    if running := describe_running(resolve_endpoint(connect)):
        words = f"No `fleet up` of {keys.describe_fleet(fleet)} answers, but {running}. Repeat this in a few seconds."
        return click.ClickException(f"{words} `fleet list` shows the cars.")
    return click.ClickException(f"{keys.describe_fleet(fleet).capitalize()} is not running. Start it with `fleet up`.")


class WrongFile(click.ClickException):
    """The errors of a file, one per line, each with its position."""

    exit_code = 2
    own_form = True
    """True: the text is printed unchanged, because editors and CI read `FILE:LINE:COL: error: WORDS`."""


@contextmanager
def cli_errors() -> Iterator[None]:
    """Turn expected errors into click's errors: exit code 2 for wrong use, 1 for a failure."""
    try:
        yield
    except click.ClickException as error:
        vars(error)["message"] = complete_hints(error.message, hint_options())  # click declares `message` final
        raise
    except (BadEndpoint, ValueError) as error:  # BadKey is a ValueError
        # Only a BadFile of schemas.yaml_document has `problems`. It is recognized in this way, because importing the
        # class would slow down every other command.
        if hasattr(error, "problems"):
            raise WrongFile(str(error)) from None
        raise click.UsageError(complete_hints(str(error), hint_options())) from None
    except BusError as error:
        words = str(explain_no_fleet(error) if isinstance(error, NoFleet) else error)
        raise click.ClickException(complete_hints(words, hint_options())) from None
