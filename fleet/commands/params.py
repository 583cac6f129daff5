"""Types of arguments and options that several subcommands accept, and key expressions."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from stat import S_ISDIR
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click
from click.shell_completion import CompletionItem

from fleet.client.client import Fleet
from fleet.client.condition import topics_under
from fleet.client.lost_hub import describe_running
from fleet.client.refused_by_hub import why_refused
from fleet.client.supervision import ask_status, fleets_on, groups_of
from fleet.recording.session_lookup import NoLatest, find_session, newest_first, sessions_in, sessions_place
from fleet.recording.time_spec import ago_s
from schemas import keys
from schemas.bus import Bus, canon
from schemas.colors import COLORS, parse_color
from schemas.duration import duration_s, format_duration, parse_duration
from schemas.suggestion import did_you_mean
from schemas.topics import likely_name

if TYPE_CHECKING:
    from fleet.fleetfile.fleet_file import FleetFile

N = TypeVar("N", bound=float)

ALL_CARS: Final = "all"
COMPLETION_TIMEOUT_S: Final = 0.3
_PLACE: Final = "fleet.sessions"
"""Key in click's context under which the value of --sessions is stored."""


class Duration(click.ParamType[float]):
    """A duration: `500ms`, `2s`, `1m30s`, `1h`, or a number of seconds."""

    name = "DURATION"

    def __init__(self, max_s: float, min_s: float = 0.0) -> None:
        self._max_s, self._min_s = max_s, min_s

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the duration in seconds. Fail outside the range."""
        try:
            return parse_duration(str(value), self._min_s, self._max_s)
        except ValueError as error:
            self.fail(f"{error}.", param, ctx)


class Since(click.ParamType[float]):
    """A time in the past: how long ago (`30s`, `-5m`), a local time (`14:05`, `yesterday 14:05`), a day, or a date."""

    name = "TIME"

    def __init__(self, max_s: float) -> None:
        self._max_s = max_s

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return how long ago the time was, s. Fail for a time in the future, or longer ago than the maximum."""
        text = str(value)
        ago = text.removeprefix("-")
        if duration_s(ago) is not None:
            return Duration(self._max_s).convert(ago, param, ctx)
        try:
            found_s = ago_s(text, time.time())
        except ValueError as error:
            self.fail(str(error), param, ctx)
        if found_s > self._max_s:
            self.fail(f"{text} is too long ago: the maximum is {format_duration(self._max_s)}.", param, ctx)
        return found_s


class Number(click.ParamType[N]):
    """A number within a range. `kind` is int or float."""

    def __init__(self, kind: type[N], least: N, most: N | None = None) -> None:
        self.name = "N" if kind is int else "FACTOR"
        self._kind, self._least, self._most = kind, least, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> N:
        """Return the number. Fail outside the range."""
        try:
            number = self._kind(value)
        except ValueError:
            self.fail(f'"{value}" is not a {"whole " if self._kind is int else ""}number.', param, ctx)
        if not number >= self._least:
            self.fail(f"{value} is too small: the minimum is {self._least:g}.", param, ctx)
        if self._most is not None and number > self._most:
            self.fail(f"{value} is too large: the maximum is {self._most:g}.", param, ctx)
        return number


class Choice(click.Choice[str]):
    """A word of a fixed list, such as a motion. The error for another word names the likely one."""

    def __init__(self, what: str, choices: Iterable[str], hints: Mapping[str, str] | None = None) -> None:
        super().__init__([str(each) for each in choices])
        self._what, self._hints = what, hints or {}

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """Return the name of an argument, or the choices of an option."""
        return (param.name or "").upper() if isinstance(param, click.Argument) else super().get_metavar(param, ctx)

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """Return the error text, with the likely word, or with all words if none is likely."""
        if self._what == "motion" and duration_s(str(value)) is not None:
            hint = f"Write the duration as --for {value}."
        elif ctx is not None and set(ctx.params.get("cars", ())) & set(self.choices):
            hint = f"Write the {self._what} last."
        else:
            hint = self._hints.get(value) or did_you_mean(str(value), self.choices)
            hint = hint or f"Choose from: {', '.join(self.choices)}."
        return f'"{value}" is not a {self._what}. {hint}'


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


class Color(click.ParamType[tuple[int, int, int]]):
    """A color: a name, or red, green and blue as `#rrggbb`."""

    name = "COLOR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int, int]:
        """Return three numbers, 0..255."""
        try:
            return value if isinstance(value, tuple) else parse_color(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002 - click's signature
        """Return names of colors."""
        return [CompletionItem(name) for name in COLORS if name.startswith(incomplete)]


class SessionPath(click.ParamType[Path]):
    """A session: its directory, its name in the directory of sessions, `latest`, or `latest~1` for the one before."""

    name = "SESSION"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path. Fail if there are fewer sessions than `latest~N` needs."""
        place = (ctx.meta.get(_PLACE) if ctx is not None else None) or sessions_place()
        try:
            return find_session(value, place)
        except NoLatest as error:
            if newest_first(place):
                self.fail(str(error), param, ctx)
            raise click.ClickException(str(error)) from None

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002 - click's signature
        """Return the names of sessions, or let the shell complete a path."""
        there = sorted(each.name for each in sessions_in(ctx.meta.get(_PLACE) or sessions_place()))
        names = ["latest", *reversed(there)]
        fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return fitting or [CompletionItem(incomplete, type="file")]


def _flat(_: click.Context, __: click.Parameter, value: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Return the names in all arguments, such as `red,blue` and `green`, each once."""
    return tuple(dict.fromkeys(name for names in value for name in names))


def _require_cars(ctx: click.Context, param: click.Parameter, value: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Return the names in all arguments, each once. Fail with an example if no car is named."""
    if not value:
        raise click.UsageError(describe_usage(ctx), ctx)
    return _flat(ctx, param, value)


def describe_usage(ctx: click.Context) -> str:
    """Return the error text for missing arguments: what to write, with the first example of the command."""
    pieces = [each for each in ctx.command.collect_usage_pieces(ctx) if each != "[OPTIONS]"]
    example = next(line.strip() for line in (ctx.command.epilog or "").splitlines() if line.startswith("  fleet"))
    return f"Write: {ctx.command_path} {' '.join(pieces)}, such as: {example}"


def _place(ctx: click.Context, _: click.Parameter, value: Path | None) -> None:
    ctx.meta[_PLACE] = value


cars_argument = click.argument("cars", type=CarNames(), nargs=-1, metavar="CAR...", callback=_require_cars)
any_cars_argument = click.argument("cars", type=CarNames(), nargs=-1, metavar="[CAR...]", callback=_flat)
stopped_cars_argument = click.argument("cars", type=NamesToStop(), nargs=-1, metavar="[CAR...]", callback=_flat)
car_option = click.option(
    "--car", "cars", type=CarNames(), multiple=True, metavar="CAR[,CAR...]", callback=_flat, help="Use only these cars."
)


def session_argument(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the argument SESSION, the newest session by default, and --sessions."""
    place = click.option(
        "--sessions",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="DIR",
        is_eager=True,
        expose_value=False,
        callback=_place,
        help="Search for SESSION in DIR (default: sessions).",
    )
    return place(click.argument("session", type=SessionPath(), default="latest", metavar="[SESSION]")(function))


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


def existing_sessions_place(directory: Path | None) -> Path:
    """Return this directory of sessions, or the default one. Raises a ClickException if it does not exist."""
    place = directory or sessions_place()
    try:
        is_there = S_ISDIR(place.stat().st_mode)  # since Python 3.14, `is_dir` hides a missing permission
    except (FileNotFoundError, NotADirectoryError):
        is_there = False
    except OSError as error:  # we may not enter a directory on the way
        raise click.ClickException(f"{place} cannot be listed: {error.strerror}.") from None
    if not is_there:
        raise click.ClickException(f"There is no directory {place}. `fleet up` records everything.")
    return place
