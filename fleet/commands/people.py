"""`fleet pause, unpause, lend`: a lead's commands for the cars of all people."""

import click

from fleet.client.client import Fleet
from fleet.commands.car_names import cars_argument, complete_people, resolve_cars
from fleet.commands.exit_code import end_with
from fleet.commands.options import json_option, with_client
from fleet.commands.params import Duration
from schemas.commands import COMMANDS, Verb


@click.command(epilog="\b\nexamples:\n  fleet pause\n  fleet pause --why 'look at the board' --as teacher")
@click.option("--why", default="", metavar="WORDS", help="The reason. Everyone whose command is refused sees it.")
@json_option
@with_client
def pause(client: Fleet, why: str, *, as_json: bool) -> None:
    """Stop all cars. Until `fleet unpause` only a lead can move a car, even after a restart.

    If the fleet file has no leads, any person may pause, and nobody can move a car until the end of the pause.
    """
    end_with(client, client.pause(why), as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet unpause --as teacher")
@json_option
@with_client
def unpause(client: Fleet, *, as_json: bool) -> None:
    """End the pause of the fleet. A plan may move cars at once. A car that was on hold before stays on hold."""
    end_with(client, client.unpause(), as_json=as_json)


@click.command(
    epilog="""\b
examples:
  fleet lend red,blue --to group_a --for 10m --as teacher
  fleet lend red --end --as teacher"""
)
@cars_argument
@click.option("--to", metavar="PERSON", shell_complete=complete_people, help="Lend the cars to PERSON.")
@click.option(
    "--for",
    "duration_s",
    type=Duration(COMMANDS[Verb.LEND].max_duration_s),
    help="How long to lend them, such as 10m. At most 24h.",
)
@click.option("--end", is_flag=True, help="End the loan now. A car that the borrower drives stops.")
@json_option
@with_client
def lend(
    client: Fleet, cars: tuple[str, ...], *, to: str | None, duration_s: float | None, end: bool, as_json: bool
) -> None:
    """Lend cars to a person. During the loan, only that person and leads can drive them.

    If the fleet file has no leads, any person may lend cars. When the loan ends, a car that the borrower drives stops.
    """
    if end and (to or duration_s):
        raise click.UsageError("--end ends the loan: leave --to and --for out")
    if not end and not (to and duration_s):
        raise click.UsageError(f"Say to whom and for how long: fleet lend {','.join(cars)} --to PERSON --for 10m")
    named = resolve_cars(client, cars)
    if to is not None and duration_s is not None:
        outcomes = client.lend(named, to, duration_s)
    else:
        outcomes = client.end_loan(named)
    end_with(client, outcomes, as_json=as_json)
