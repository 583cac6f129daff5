"""Finds the fleet that a command means, if several are on one bus and the user has not named one.

A stop asks nobody: it stops the cars in all fleets on the bus.
"""

import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import click

from fleet.client.client import Fleet
from fleet.client.outcome import NO_ANSWER, Outcome
from fleet.client.supervision import ask_status_briefly, fleets_on, gateways_of
from fleet.commands.car_names import ALL_CARS
from fleet.commands.command_group import chosen_person, is_fleet_named, name_fleet_in_hints, remember_fleet
from schemas.bus import Bus
from schemas.words import Rank


def possible_fleets(bus: Bus, fleet: str, cars: Iterable[str] = ()) -> list[str]:
    """Return the fleets that a command for these cars could mean: those with all of the cars, or if there is none, all.

    If at most one fleet runs on the bus, return `fleet`. If there are several, hints name a fleet from now on.
    """
    found = fleets_on(bus)
    if len(found) < 2:
        return [fleet]
    name_fleet_in_hints()
    wanted = {each for each in cars if each != ALL_CARS and not each.startswith("@")}
    return sorted(name for name, members in found.items() if wanted <= members) or sorted(found)


def find_fleet(bus: Bus, fleet: str, cars: Iterable[str] = ()) -> str:
    """Return the one fleet that a command means. If it could mean several, ask the user at a terminal.

    Without a terminal, raise click.UsageError.
    """
    possible = [fleet] if is_fleet_named() else possible_fleets(bus, fleet, cars)
    if len(possible) == 1:
        return possible[0]
    if sys.stdin.isatty() and sys.stdout.isatty():
        chosen: str = click.prompt("Which fleet?", type=click.Choice(possible), err=True)
        return chosen
    raise _ambiguous(possible)


def client_in(connect: str | None, fleet: str) -> Fleet:
    """Open a client in exactly this fleet, for the person whom --as or FLEET_AS names."""
    return Fleet(connect, fleet, kind=Rank.PERSON, person=chosen_person())


def open_client(connect: str | None, fleet: str, cars: Iterable[str] = ()) -> Fleet:
    """Open a client as `client_in` does, in the fleet that the command means. Raises click.UsageError."""
    return _open_chosen(connect, fleet, lambda bus: find_fleet(bus, fleet, cars))


def open_observer(connect: str | None, fleet: str, keyexpr: str = "") -> Fleet:
    """Open a client as `client_in` does, for a key expression that the user wrote.

    Raises click.UsageError if the expression could mean several fleets.
    """
    return _open_chosen(connect, fleet, lambda bus: _only_fleet(bus, fleet, keyexpr.partition("/")[0]))


def _open_chosen(connect: str | None, fleet: str, choose: Callable[[Bus], str]) -> Fleet:
    """Open a client. `choose` gets its bus, and returns the name of the fleet to use."""
    client = client_in(connect, fleet)
    try:
        name = choose(client.bus)
        if name == fleet:
            return client
        remember_fleet(connect, name)
    except BaseException:
        client.close()
        raise
    client.close()
    return client_in(connect, name)


def _only_fleet(bus: Bus, fleet: str, first: str) -> str:
    """Return this fleet. Fail if a key expression that begins with `first` could mean another fleet, too."""
    if is_fleet_named() or first in ("**", fleet):
        return fleet
    has_wildcard = bool(set(first) & set("*$"))
    possible = possible_fleets(bus, fleet, [first] if first and not has_wildcard else ())
    if possible != [fleet]:
        raise _ambiguous(possible)
    return fleet


def _ambiguous(possible: Sequence[str]) -> click.UsageError:
    if len(possible) == 1:
        return click.UsageError(
            f"Several fleets are on this bus, and only {possible[0]} has that: add --fleet {possible[0]}."
        )
    return click.UsageError(f"Several fleets could be meant: {', '.join(possible)}. Say which one with --fleet NAME.")


def stop_in_all_fleets(client: Fleet, connect: str | None, act: Callable[[Fleet], Sequence[Outcome]]) -> list[Outcome]:
    """Stop the cars in this client's fleet, and meanwhile in every other fleet on the bus, unless the user named one.

    `act` stops the cars in the fleet of a client, and returns their outcomes. A car whose gateway hangs has no token.
    So nobody can tell before the stop which fleets have the cars, and each fleet is asked for each car.
    """
    if is_fleet_named():
        return list(act(client))
    members: dict[str, set[str]] = {}

    def stop_elsewhere() -> list[tuple[str, Outcome]]:
        members.update(fleets_on(client.bus))
        others = sorted(members.keys() - {client.name})
        if not others:
            return []
        with ThreadPoolExecutor(len(others)) as pool:
            found = pool.map(stop_in, others)
            return [(name, each) for name, outcomes in zip(others, found, strict=True) for each in outcomes]

    def stop_in(name: str) -> list[Outcome]:
        with Fleet(connect, name, sender=client.sender, kind=client.kind) as there:
            return list(act(there))

    with ThreadPoolExecutor(1) as pool:
        elsewhere = pool.submit(stop_elsewhere)
        own = list(act(client))
        further = elsewhere.result()
    if further:
        name_fleet_in_hints()
    outcomes = _without_strangers(client.bus, [*((client.name, each) for each in own), *further], members)
    return [each if fleet == client.name else replace(each, car=f"{fleet}/{each.car}") for fleet, each in outcomes]


def _without_strangers(
    bus: Bus, outcomes: Sequence[tuple[str, Outcome]], members: dict[str, set[str]]
) -> list[tuple[str, Outcome]]:
    """Leave out the outcomes of cars in fleets to which they do not belong, by fleet.

    A car that has answered in one fleet is a stranger in each other fleet where it has no answer. But a fleet may have
    a car of the same name that should have answered, and did not. That is bad news, so it stays: it is a car in
    `members`, or one that the supervisor knows because it runs its gateway.
    """
    answered = {each.car for _, each in outcomes if each.phase != NO_ANSWER}
    silent = {fleet for fleet, each in outcomes if each.phase == NO_ANSWER and each.car in answered}
    for fleet in silent:
        members.setdefault(fleet, set()).update(*map(gateways_of, ask_status_briefly(bus, fleet)))
    return [
        (fleet, each)
        for fleet, each in outcomes
        if each.phase != NO_ANSWER or each.car not in answered or each.car in members.get(fleet, ())
    ]
