"""Types of arguments and options that several subcommands accept: durations, numbers, words, colors, sessions."""

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from stat import S_ISDIR
from typing import Any, Final, TypeVar

import click
from click.shell_completion import CompletionItem

from fleet.recording.session_lookup import NoLatest, find_session, newest_first, sessions_in, sessions_place
from fleet.recording.time_spec import ago_s
from schemas.colors import COLORS, parse_color
from schemas.duration import duration_s, format_duration, parse_duration
from schemas.suggestion import did_you_mean

N = TypeVar("N", bound=float)

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
        place = ctx.meta.get(_PLACE) if ctx is not None else None
        try:
            return find_session(value, place)
        except NoLatest as error:
            if newest_first(place or sessions_place()):
                self.fail(str(error), param, ctx)
            raise click.ClickException(str(error)) from None

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002 - click's signature
        """Return the names of sessions, or let the shell complete a path."""
        there = sorted(each.name for each in sessions_in(ctx.meta.get(_PLACE) or sessions_place()))
        names = ["latest", *reversed(there)]
        fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return fitting or [CompletionItem(incomplete, type="file")]


def describe_usage(ctx: click.Context) -> str:
    """Return the error text for missing arguments: what to write, with the first example of the command."""
    pieces = [each for each in ctx.command.collect_usage_pieces(ctx) if each != "[OPTIONS]"]
    example = next(line.strip() for line in (ctx.command.epilog or "").splitlines() if line.startswith("  fleet"))
    return f"Write: {ctx.command_path} {' '.join(pieces)}, such as: {example}"


def _place(ctx: click.Context, _: click.Parameter, value: Path | None) -> None:
    ctx.meta[_PLACE] = value


def session_argument(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the argument SESSION, the newest session by default, and --sessions."""
    place = click.option(
        "--sessions",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="DIR",
        is_eager=True,
        expose_value=False,
        callback=_place,
        help="Search for SESSION in DIR (default: as in the fleet file here, or sessions).",
    )
    return place(click.argument("session", type=SessionPath(), default="latest", metavar="[SESSION]")(function))


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
