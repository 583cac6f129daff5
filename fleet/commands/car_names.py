"""Cars as arguments: their names, `all`, and `@group`; how a shell completes them; texts about missing cars."""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from fleet.client.client import Fleet
from fleet.client.condition import topics_under
from fleet.client.hub_ended import describe_running
from fleet.client.refused_by_hub import why_refused
from fleet.client.supervision import ask_status, fleets_on, groups_of
from fleet.commands.params import describe_usage
from schemas import keys
from schemas.bus import Bus, canon
from schemas.suggestion import did_you_mean
from schemas.topics import likely_name

if TYPE_CHECKING:
    from fleet.fleetfile.fleet_file import FleetFile

ALL_CARS: Final = "all"
COMPLETION_TIMEOUT_S: Final = 0.3


class CarNames(click.ParamType[tuple[str, ...]]):
    """Cars: `red`, `red,blue`, `all`, or `@group`."""

    name = "CAR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Return the names as typed. Fail if one cannot be a name."""
        if isinstance(value, tuple):
            return value
        names = tuple(str(value).split(","))
        for name in names:
            try:
                keys.check_name(name.removeprefix("@"))
            except keys.BadKey as error:
                lower = name.lower()
                if lower != name and keys.is_name(lower.removeprefix("@")):
                    what = "group" if name.startswith("@") else "car"
                    self.fail(f'No {what} "{name}". Names are lower case: did you mean "{lower}"?', param, ctx)
                self.fail(str(error), param, ctx)
        return names

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return connected cars, and words for the next argument, as in `fleet drive red fo`."""
        found = [CompletionItem(name) for name in complete_cars(ctx, param, incomplete)]
        if isinstance(param, click.Argument):
            words = [each for each in ctx.command.params if isinstance(each, click.Argument) and each is not param]
            found += [item for each in words[:1] for item in each.shell_complete(ctx, incomplete)]
        return found


class NamesToStop(CarNames):
    """Cars to stop. A wrong name must not keep the others from being stopped, so it is returned as it was typed."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:  # noqa: ARG002 - click's signature
        """Return the names. Names are lower case, and a stop of `RED` means red."""
        if isinstance(value, tuple):
            return value
        names = (each.strip() for each in str(value).split(","))
        return tuple(each.lower() if keys.is_name(each.lower().removeprefix("@")) else each for each in names if each)


def complete_cars(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Return connected cars for the shell, also after a comma, and groups. It never fails, prints, or takes long."""
    earlier, comma, begin = incomplete.rpartition(",")
    named = earlier.split(",")
    if begin.startswith("@"):
        running = _ask_bus(ctx, lambda bus, fleet: _groups_of_status(ask_status(bus, fleet, COMPLETION_TIMEOUT_S)))
        names = [f"@{group}" for group in running or sorted(_groups_of_file())]
    else:
        names = [*_connected(ctx), ALL_CARS]
    return [f"{earlier}{comma}{name}" for name in names if name.startswith(begin) and name not in named]


def complete_car(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Return connected cars for the shell, for arguments that accept neither `all` nor a group."""
    return [name for name in _connected(ctx) if name.startswith(incomplete)]


def _connected(ctx: click.Context) -> list[str]:
    return _ask_bus(
        ctx, lambda bus, fleet: [each.rpartition("/")[2] for each in bus.tokens(keys.car_token(fleet, "*"))]
    )


def _ask_bus(ctx: click.Context, ask: Callable[[Bus, str], Iterable[str]]) -> list[str]:
    """Return the names that `ask` finds on the bus, sorted. Empty if the bus does not answer in time."""
    values = {**ctx.find_root().params, **{name: value for name, value in ctx.params.items() if value}}
    fleet = values.get("fleet") or keys.DEFAULT_FLEET  # click does not set defaults during completion
    found: list[str] = []

    def look() -> None:
        with suppress(Exception), Bus.open(values.get("connect")) as bus:
            found.extend(ask(bus, fleet))

    logging.disable()  # completion must not print
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    thread.join(COMPLETION_TIMEOUT_S)
    return sorted(found)


def _flat(_: click.Context, __: click.Parameter, value: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Return the names in all arguments, such as `red,blue` and `green`, each once."""
    return tuple(dict.fromkeys(name for names in value for name in names))


def _require_cars(ctx: click.Context, param: click.Parameter, value: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Return the names in all arguments, each once. Fail with an example if no car is named."""
    if not value:
        raise click.UsageError(describe_usage(ctx), ctx)
    return _flat(ctx, param, value)


cars_argument = click.argument("cars", type=CarNames(), nargs=-1, metavar="CAR...", callback=_require_cars)


any_cars_argument = click.argument("cars", type=CarNames(), nargs=-1, metavar="[CAR...]", callback=_flat)


stopped_cars_argument = click.argument("cars", type=NamesToStop(), nargs=-1, metavar="[CAR...]", callback=_flat)


car_option = click.option(
    "--car", "cars", type=CarNames(), multiple=True, metavar="CAR[,CAR...]", callback=_flat, help="Use only these cars."
)


def resolve_cars(client: Fleet, written: Sequence[str]) -> list[str]:
    """Return the names of the cars: `all` stands for every connected car. Raises click's errors."""
    found: list[str] = []
    for each in written:
        if each == ALL_CARS:
            if not (connected := client.cars()):
                raise no_cars(client)
            found += connected
        elif each.startswith("@"):
            found += _members(client, each.removeprefix("@"))
        else:
            found.append(each)
    return list(dict.fromkeys(found))


def _members(client: Fleet, group: str) -> Sequence[str]:
    """Return the cars of a group, from the running fleet, or else from the fleet file here. Raises click's errors."""
    status = ask_status(client.bus, client.name)
    groups = _groups_of_status(status) if status else _groups_of_file()
    if groups.get(group):
        return groups[group]
    if group in groups:
        raise click.ClickException(f'The group "@{group}" has no cars.')
    if groups:
        near = did_you_mean(group, groups).replace("mean ", "mean @")
        hint = near or f"Groups: @{', @'.join(sorted(groups))}."
    else:
        whose = "The running fleet has none. Its file" if status else "fleet.yaml"
        hint = f"{whose} can define groups, such as `groups: {{a: [red, blue]}}`."
    raise click.ClickException(f'There is no group "@{group}". {hint}')


def _groups_of_status(status: Iterable[Any]) -> Mapping[str, Sequence[str]]:
    """Return the groups that supervisors name."""
    return {name: cars for each in status for name, cars in groups_of(each).items()}


def _groups_of_file() -> Mapping[str, Sequence[str]]:
    """Return the groups in the fleet file here. Empty if there is no such file, or it is wrong."""
    file = _file_here()
    return file.groups if file else {}


def complete_people(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    """Complete, in the shell, the name of a person in the fleet file here. Never fails or prints."""
    file = _file_here()
    return sorted(name for name in (file and file.people) or () if name.startswith(incomplete))


def _file_here() -> "FleetFile | None":
    """Return the fleet file here. None if there is no such file, or it is wrong."""
    if Path("fleet.yaml").is_file():
        from fleet.fleetfile.fleet_file import read_fleet

        with suppress(ValueError):  # BadFile is a ValueError
            return read_fleet(Path("fleet.yaml"), unbound=True)
    return None


def expand_key(keyexpr: str, fleet: str) -> str:
    """Expand a key expression. Raises keys.BadKey."""
    return canon(keys.expand(keyexpr, keys.check_name(fleet, "fleet name")))


def no_cars(client: Fleet) -> click.ClickException:
    """Return the error that no car is connected.

    It names the other fleets if this fleet is not on the bus, or says why the hub passes nothing on, or names a hub
    that has just started.
    """
    if others := describe_other_fleets(client):
        return click.ClickException(others)
    if refused := why_refused(client):
        return click.ClickException(refused)
    words = "No car is connected."
    if running := describe_running(client.bus.endpoint):  # gateways may be about to reconnect to a restarted hub
        words = f"No car is connected, but {running}. Repeat this in a few seconds. If it fails again, go to the cars."
    return click.ClickException(words)


def describe_other_fleets(client: Fleet) -> str:
    """Return a text that names the fleets on the bus. Empty if this fleet is among them, or if there is none."""
    there = fleets_on(client.bus)
    if not there or client.name in there:
        return ""
    return f'No fleet "{client.name}" is on this bus. There is: {", ".join(sorted(there))}.'


def describe_missing(client: Fleet, key_expression: str, what: str) -> str:
    """Return a text for a key without a value. It names the likely car, the car's readings, or the connected cars."""
    matched = topics_under(key_expression)
    if matched and all(topic.family == "sim" for topic in matched):
        short = key_expression.partition("/")[2]
        return f"{what}; a simulated car's true state is not stored. Watch it: fleet watch {short}"
    cars = client.cars()
    if not cars:
        return no_cars(client).message
    key = keys.parse(key_expression)
    if key is not None and key.car in cars:
        begin = len(f"{client.name}/{key.car}/")
        found = [reading.key[begin:] for reading in client.get(f"{client.name}/{key.car}/*/*")]
        return f"{what}; {key.car} has {', '.join(found)}" if found else f"{what}; {key.car} publishes nothing"
    if key is not None and not set(key.car) & set("*$@"):
        return f'No car "{key.car}". {_likely_car(key.car, cars)}'
    return f"{what}; connected: {', '.join(cars)}"


def _likely_car(name: str, cars: Sequence[str]) -> str:
    """Return a text for an unknown car: the likely car, else the topic of this name, else the connected cars."""
    topic = None if (near := did_you_mean(name, cars)) else likely_name(name)
    return near or (f"Did you mean '*/{topic}'?" if topic else f"Connected: {', '.join(cars)}.")


def warn_if_missing(key_expression: str, cars: Sequence[str]) -> None:
    """Warn if the named car is not on the bus: the name may be misspelled."""
    key = keys.parse(key_expression)
    if key is not None and not set(key.car) & set("*$@") and key.car not in cars:
        there = _likely_car(key.car, cars) if cars else "No car is connected."
        click.echo(f'fleet: No car "{key.car}" is connected yet. {there} Waiting.', err=True)
