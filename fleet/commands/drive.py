"""`fleet drive, mode, stop, estop, resume`: the commands that move cars or stop them."""

import time
from collections.abc import Callable, Sequence
from typing import Final, Never

import click
from msgspec.structs import replace

from fleet.client.claims import NOT_STOPPED
from fleet.client.client import Fleet
from fleet.client.commands import (
    MAX_DRIVE_S,
    STOP_TTL_S,
    CommandRequest,
    drive_request,
    estop_request,
    mode_request,
    resume_request,
    stop_request,
)
from fleet.client.hub_ended import LostHub
from fleet.client.outcome import NO_ANSWER, Outcome, bus_lost_words
from fleet.commands.car_names import ALL_CARS, any_cars_argument, cars_argument, resolve_cars, stopped_cars_argument
from fleet.commands.exit_code import carry_out, end_with, print_outcomes
from fleet.commands.options import bus_options, json_option, take_option, with_client
from fleet.commands.params import Choice, Duration
from fleet.commands.which_fleet import client_in, stop_in_all_fleets
from schemas import keys
from schemas.bus import BusError, HubUnreachable, NoFleet
from schemas.process import signals, startup
from schemas.process.stdio import printable
from schemas.words import Mode, Motion, Scope

HANG_S: Final = 1.0
"""A bus that takes longer than this to answer a client hangs, and may come back."""
REJOIN_S: Final = 3.0
"""Time within which gateways come back to a bus that hung: they try twice a second."""
REJOIN_POLL_S: Final = 0.05
"""Interval at which we look for these gateways."""
_MOTIONS: Final = tuple(each for each in Motion if each is not Motion.STOP)


@click.command(
    epilog="""\b
examples:
  fleet drive red forward --for 2s
  fleet drive red blue spin_left --for 500ms
  fleet drive all forward
  fleet drive red forward --take   # another person drives it: take it over"""
)
@cars_argument
@click.argument("motion", type=Choice("motion", _MOTIONS, {Motion.STOP: "To stop cars, write: fleet stop red"}))
@click.option(
    "--for",
    "duration_s",
    type=Duration(MAX_DRIVE_S),
    default="500ms",
    show_default=True,
    help="How long to drive: at most 10s, unless the car's gateway has another limit.",
)
@take_option
@json_option
@with_client
def drive(client: Fleet, cars: tuple[str, ...], motion: str, duration_s: float, *, take: bool, as_json: bool) -> None:
    """Move for a time, then stop. The command waits until the car has stopped. Ctrl-C stops it earlier.

    MOTION is forward, back, left, right, spin_left or spin_right.
    """
    request = replace(drive_request(motion, duration_s), take=take)
    _ask_until_ctrl_c(client, request, drive_request(Motion.STOP), resolve_cars(client, cars), as_json=as_json)


@click.command(epilog="\b\nexample:\n  fleet mode red tracking\n  fleet mode red,blue manual")
@cars_argument
@click.argument("mode", type=Choice("mode", Mode))
@take_option
@json_option
@with_client
def mode(client: Fleet, cars: tuple[str, ...], mode: str, *, take: bool, as_json: bool) -> None:
    """Make cars act by themselves. `manual` ends every other mode, and the car waits for commands.

    MODE is manual, remote_control, tracking, obstacle_avoidance, color_led, light_seeking or following.

    A car is stopped first, so it may be some seconds before the mode begins. Ctrl-C meanwhile keeps the car in mode
    manual. To stop cars, use `fleet stop`: a running plan then leaves them alone.
    """
    request = replace(mode_request(mode), take=take)
    _ask_until_ctrl_c(client, request, mode_request(Mode.MANUAL), resolve_cars(client, cars), as_json=as_json)


def _ask_until_ctrl_c(
    client: Fleet, request: CommandRequest, end: CommandRequest, cars: Sequence[str], *, as_json: bool
) -> Never:
    """Send a command to these cars, and wait for its end. After Ctrl-C or SIGTERM, send them `end`."""
    with signals.sigterm_interrupts():
        try:
            outcomes = client.ask(request, cars)
        except KeyboardInterrupt:
            print_outcomes(client.ask(end, cars), as_json=as_json)
            raise SystemExit(startup.INTERRUPTED) from None
    end_with(client, outcomes, as_json=as_json)


@click.command(epilog="\b\nexamples:\n  fleet stop\n  fleet stop red blue")
@stopped_cars_argument
@json_option
@bus_options
def stop(cars: tuple[str, ...], connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Stop these cars now, or all cars if you name none.

    A running plan leaves them alone until you drive them, give them a mode, or resume them. Without --fleet, this
    reaches all fleets on the bus. `fleet estop` also makes cars refuse every command but stops.
    `fleet mode CAR manual` stops a car without a hold, so a plan may use it at once.
    """
    _stop(connect, fleet, cars, lambda _: stop_request(), as_json=as_json)


@click.command(epilog="\b\nexamples:\n  fleet estop\n  fleet estop red --why 'someone is on the track'")
@stopped_cars_argument
@click.option("--why", default="", metavar="WORDS", help="Record what happened.")
@json_option
@bus_options
def estop(cars: tuple[str, ...], why: str, connect: str | None, fleet: str, *, as_json: bool) -> None:
    """Emergency stop: these cars, or the whole fleet, stop and refuse every command but stops.

    Without --fleet, this reaches all fleets on the bus. `fleet resume --estops` releases the cars. For
    everyday use there is `fleet stop`: after it, cars obey again at once.
    """
    _stop(
        connect,
        fleet,
        cars,
        lambda named: estop_request(why, Scope.FLEET if named is None else Scope.CAR),
        as_json=as_json,
        lasts=" The emergency stop lasts until `fleet resume --estops`.",
    )


def _client_that_stops(connect: str | None, fleet: str) -> tuple[Fleet, bool]:
    """Return an open client, and True if the hub hung at first.

    If the hub hangs, try again for as long as a stop would be sent again after a loss of the bus. Each error begins
    with the consequence: nothing was stopped.
    """
    first_at = time.monotonic()
    while True:
        began = time.monotonic()
        try:
            return client_in(connect, fleet), time.monotonic() > first_at + HANG_S
        except (LostHub, HubUnreachable) as error:
            raise BusError(f"{NOT_STOPPED}: this command stopped nothing. {error}") from None
        except NoFleet:  # nothing is running, which is not a fault
            raise
        except BusError as error:
            if not began + HANG_S < time.monotonic() < first_at + STOP_TTL_S:
                raise BusError(f"{bus_lost_words('a car')} ({error})") from None
            click.echo("fleet: the fleet's bus does not answer yet: trying again", err=True)


def _stop(
    connect: str | None,
    fleet: str,
    cars: tuple[str, ...],
    request_for: Callable[[list[str] | None], CommandRequest],
    *,
    as_json: bool,
    lasts: str = "",
) -> Never:
    """Stop the cars in all fleets, unless the user named one. `request_for` makes the request for the named cars.

    After Ctrl-C, `lasts` says what stays in force.
    A word that names no car fails, and the cars of the other words are stopped all the same.
    """
    words = tuple(each for each in cars if keys.is_name(each.removeprefix("@")))
    wrong = [_not_stopped(each, f"use {keys.NAME_RULE}") for each in cars if each not in words]
    if wrong and not words:  # without a word, all cars would be meant
        raise click.UsageError("; ".join(map(str, wrong)))

    def act(there: Fleet) -> list[Outcome]:
        ask = _ask_returning if hung else Fleet.ask
        if not words or ALL_CARS in words:
            request = request_for(None)
            return [*ask(there, request, None), *_ask_missing_cars(there, request, words)]
        named, failed = _cars_to_stop(there, words)
        return [*(ask(there, request_for(named), named) if named else ()), *failed]

    client, hung = _client_that_stops(connect, fleet)
    with client:
        try:
            outcomes = stop_in_all_fleets(client, connect, act)
        except KeyboardInterrupt:
            click.echo(f"fleet: the stop was sent. Nothing shows yet that a car stands: look at it.{lasts}", err=True)
            raise
        end_with(client, [*outcomes, *wrong], as_json=as_json)


def _ask_returning(client: Fleet, request: CommandRequest, named: Sequence[str] | None) -> list[Outcome]:
    """Ask each of these cars, or all, as soon as its gateway has come back to the bus.

    The hub hung until now, so gateways join it one after the other. A query to all cars would miss those that come
    after it.
    """
    pending, asked = [], set[str]()
    until = time.monotonic() + REJOIN_S
    while time.monotonic() < until:
        if cars := [each for each in client.cars() if each not in asked and (named is None or each in named)]:
            pending.append(client.send(request, cars))
            asked.update(cars)
        if named is not None and asked >= {*named}:
            break
        time.sleep(REJOIN_POLL_S)
    if missing := [each for each in named or () if each not in asked]:  # their outcomes say that they are not there
        pending.append(client.send(request, missing))
    return [each for command in pending for each in client.outcomes(command)] if pending else client.ask(request)


def _ask_missing_cars(client: Fleet, request: CommandRequest, cars: tuple[str, ...]) -> list[Outcome]:
    """Send the request to cars that are named beside `all` but are not connected. A mistyped name then fails."""
    named = [each for each in cars if each != ALL_CARS and not each.startswith("@")] if ALL_CARS in cars else []
    connected = client.cars() if named else ()
    missing = [each for each in named if each not in connected]
    return client.ask(request, missing) if missing else []


def _cars_to_stop(client: Fleet, words: Sequence[str]) -> tuple[list[str], list[Outcome]]:
    """Return the cars that these words name, and an outcome for each word that names none."""
    named: dict[str, None] = {}
    failed = []
    for each in words:
        try:
            named.update(dict.fromkeys(resolve_cars(client, [each])))
        except click.ClickException as error:
            failed.append(_not_stopped(each, error.message))
    return list(named), failed


def _not_stopped(word: str, why: str) -> Outcome:
    return Outcome(printable(word), ok=False, phase=NO_ANSWER, words=f"{NOT_STOPPED}: {why}")


@click.command(
    epilog="""\b
examples:
  fleet resume
  fleet resume red
  fleet resume red --estops
  fleet resume --all
  fleet resume red blue --id 5f0c2e"""
)
@any_cars_argument
@click.option(
    "--id",
    "ids",
    multiple=True,
    metavar="ID",
    help="Release this emergency stop. The beginning of its id is enough. Repeatable.",
)
@click.option("--estops", is_flag=True, help="Release every emergency stop of these cars. They stay on hold.")
@click.option(
    "--all",
    "everything",
    is_flag=True,
    help="End the hold and every emergency stop that you may end. Print which ones remain.",
)
@json_option
@with_client
def resume(
    client: Fleet, cars: tuple[str, ...], ids: tuple[str, ...], *, estops: bool, everything: bool, as_json: bool
) -> None:
    """Let the plan use stopped cars again: these cars, or all cars if you name none.

    --estops also releases emergency stops. The cars stay stopped and wait for a second `fleet resume`. An emergency
    stop of the whole fleet ends for every car when it ends for one. Only a lead can end a stop by a lead.
    """
    if estops and ids:
        raise click.UsageError("--estops releases every emergency stop: leave --id out")
    if everything and (estops or ids):
        raise click.UsageError("--all ends everything: leave --estops and --id out")
    if everything:
        end_with(client, client.resume(_named(client, cars), everything=True), as_json=as_json)
    elif estops or ids:
        _release_estops(client, resolve_cars(client, cars or [ALL_CARS]), ids, as_json=as_json)
    else:
        carry_out(client, resume_request(), cars or [ALL_CARS], as_json=as_json)


def _release_estops(client: Fleet, cars: Sequence[str], ids: tuple[str, ...], *, as_json: bool) -> None:
    """Release the e-stops with these ids, or all e-stops of the cars without ids. Exit with the code of `end_with`."""
    connected = client.cars()
    cars_by_ids: dict[tuple[str, ...], list[str]] = {}
    for car in cars:  # look at all cars before the first release, because the release of one car may free the others
        in_force = _in_force(client, car)
        chosen = tuple([_complete_id(car, prefix, in_force) for prefix in ids] if ids else in_force)
        if chosen or car not in connected:  # the outcome for a car that is not connected says that it is not
            cars_by_ids.setdefault(chosen, []).append(car)
        else:
            click.echo(f"{car}: no e-stop is in force", err=True)
    if not cars_by_ids:
        return
    outcomes = [each for chosen, names in cars_by_ids.items() for each in client.ask(resume_request(chosen), names)]
    end_with(client, sorted(outcomes, key=lambda each: each.car), as_json=as_json)


def _in_force(client: Fleet, car: str) -> list[str]:
    """Return the ids of the e-stops in force on a car."""
    return [estop.id for reading in client.get(f"{car}/state/safety") for estop in reading.value.estops]


def _complete_id(car: str, prefix: str, in_force: list[str]) -> str:
    """Return the id with this prefix, or the prefix itself if none has it. The gateway then rejects it."""
    found = [each for each in in_force if each.startswith(prefix)]
    if len(found) > 1 and prefix not in found:
        raise click.UsageError(f"--id {prefix}: several e-stops of {car} begin with that: {', '.join(found)}")
    return prefix if prefix in found or not found else found[0]


def _named(client: Fleet, cars: tuple[str, ...]) -> list[str] | None:
    """Return the cars, or None for all. With None, one query reaches all cars, also those that joined just now."""
    return resolve_cars(client, cars) if cars and ALL_CARS not in cars else None
