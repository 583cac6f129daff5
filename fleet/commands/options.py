"""What the subcommands share: options, types of arguments, a client on the bus, and what is said of outcomes."""

import functools
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, Never

import click

from fleet.client.client import Fleet
from fleet.client.commands import LONGEST_DRIVE_S, CommandRequest
from fleet.client.outcome import Outcome
from schemas import keys
from schemas.bus import BadEndpoint, BusError

_Function = Callable[..., Any]

from_option = click.option(
    "--from", "start", metavar="TIME", help="90s or 1m30s after the start, -60s before the end, or a date."
)
to_option = click.option("--to", "end", metavar="TIME", help="Likewise; what comes then is not part of it.")
json_option = click.option("--json", "as_json", is_flag=True, help="One JSON object per line.")


def bus_options(function: _Function) -> _Function:
    """Add --connect and --fleet; a bus that cannot be had and a bad name become one line."""

    @click.option(
        "--connect", metavar="ENDPOINT", help="The bus, tcp/HOST:PORT (default: FLEET_ENDPOINT, or loopback port 7447)."
    )
    @click.option("--fleet", default=keys.DEFAULT_FLEET, show_default=True, help="Name of the fleet.")
    @functools.wraps(function)
    def command(*args: Any, **options: Any) -> Any:
        with explained():
            return function(*args, **options)

    return command


def with_client(function: _Function) -> _Function:
    """As `bus_options`; the command gets an open client of a person instead."""

    @bus_options
    @functools.wraps(function)
    def command(*args: Any, connect: str | None, fleet: str, **options: Any) -> Any:
        with Fleet(connect, fleet, kind="person") as client:
            return function(client, *args, **options)

    return command


class WrongFile(click.ClickException):
    """A file with faults, each in a line of its own that begins with the place: shown as they are."""

    exit_code = 2


@contextmanager
def explained() -> Iterator[None]:
    """Turn what a user can cause into click's errors: exit code 2 for wrong use, 1 for a failure."""
    try:
        yield
    except (BadEndpoint, ValueError) as error:  # BadKey is a ValueError
        # A BadFile of schemas.yaml_document, whose import would slow down every other command.
        if hasattr(error, "problems"):
            raise WrongFile(str(error)) from None
        raise click.UsageError(str(error)) from None
    except BusError as error:
        raise click.ClickException(str(error)) from None


class CarNames(click.ParamType[tuple[str, ...]]):
    """One car or several: `red`, or `red,blue`."""

    name = "CAR[,CAR...]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """The names; fails with the rule for one that cannot be."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(keys.check_name(name) for name in str(value).split(","))
        except keys.BadKey as error:
            self.fail(str(error), param, ctx)


class SecondsType(click.ParamType[float]):
    """A time: `2s`, `500ms`, or a number of seconds."""

    name = "TIME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Seconds; fails outside a drive's range."""
        match = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)(ms|s|)", str(value))
        seconds = float(match[1]) / (1000 if match[2] == "ms" else 1) if match else 0.0
        if not 0 < seconds <= LONGEST_DRIVE_S:
            self.fail(
                f"{value!r} is not allowed: more than 0 and at most {LONGEST_DRIVE_S:g} s, as 2s or 500ms", param, ctx
            )
        return seconds


cars_argument = click.argument("cars", type=CarNames(), metavar="CAR[,CAR...]")
take_option = click.option("--take", is_flag=True, help="Also if another person drives the car: it is yours then.")


def carry_out(
    client: Fleet, request: CommandRequest, cars: Iterable[str], *, as_json: bool, take: bool = False
) -> None:
    """Ask the cars, say for each what became of it, and end with the exit code that says whether all was done."""
    end_with(client.ask(replace(request, take=take), cars), as_json=as_json)


def end_with(outcomes: Sequence[Outcome], *, as_json: bool) -> Never:
    """Say what became of a command on each car; exit code 0 if all was carried out, 2 for a bad value, else 1."""
    say(outcomes, as_json=as_json)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    wrong = bool(failed) and all(outcome.reason == "bad_value" for outcome in failed)
    raise SystemExit(2 if wrong else 1 if failed else 0)


def say(outcomes: Iterable[Outcome], *, as_json: bool) -> None:
    """One line for each car; what was not carried out goes to stderr, unless a script reads it."""
    for outcome in outcomes:
        if as_json:
            click.echo(json.dumps(asdict(outcome)))
        else:
            click.echo(_words(outcome), err=not outcome.ok)


def _words(outcome: Outcome) -> str:
    if not outcome.ok:
        # Who asks here is a person, so that only another person keeps the car from them.
        return f"{outcome}{' (--take)' if outcome.reason == 'leased' else ''}"
    notes = [outcome.words] if outcome.words else []
    if outcome.worst_case_s is not None:
        notes.append(f"motors off within {outcome.worst_case_s:.2f} s if the frames arrived")
    more = f" ({'; '.join(notes)})" if notes else ""
    how = f", {outcome.basis}" if outcome.basis == "shown" else ", nothing shows it" if outcome.basis else ""
    return f"{outcome.car}: {outcome.phase} after {outcome.took_s:.2f} s{how}{more}"
