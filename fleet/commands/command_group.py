"""Parts that the group of commands and its commands share. Imports no command and no bus, so that help is fast."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click
from click.core import ParameterSource

from fleet.client.hints import complete_hints, fleet_options
from schemas.keys import DEFAULT_FLEET, BadKey, check_name
from schemas.suggestion import did_you_mean

PERSON: Final = "fleet.person"
"""Key in click's context under which the value of --as is stored."""
_BUS: Final = "fleet.bus"
_NAMED: Final = "fleet.named"
"""Key in the context: True if proposed commands must name the fleet."""

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class CommandGroup(click.Group):
    """A group that proposes the likely command after a typing error."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the arguments name. Fail with the likely name."""
        try:
            return super().resolve_command(ctx, args)
        except click.exceptions.NoSuchCommand:
            near = did_you_mean(args[0], self.list_commands(ctx))
            raise click.UsageError(f'There is no command "{args[0]}". {near}'.rstrip(), ctx) from None


class DefaultCommandGroup(CommandGroup):
    """A group with a command that may be left out: `fleet sessions DIR` is `fleet sessions list DIR`.

    If another word follows the first one, the first one must be a command, because a default command accepts at most
    one word.
    """

    def __init__(self, *arguments: Any, default_command: str, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.no_args_is_help = False
        self._default_command = default_command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default command before the arguments, unless they begin with a command or its misspelling."""
        first = args[0] if args else "-"
        if first.startswith("-") and args[-1:] and args[-1] in self.commands:
            raise click.UsageError(f"Write the command first: {ctx.command_path} {args[-1]}", ctx)
        is_command = first in {*self.commands, *ctx.help_option_names}
        is_misspelled = bool(did_you_mean(first, self.commands)) or (bool(args[1:]) and not args[1].startswith("-"))
        if not is_command and (first.startswith("-") or not is_misspelled or Path(first).exists()):
            args = [self._default_command, *args]
        return super().parse_args(ctx, args)


def _from_group(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
    """Return the value of the option, or the value that was given before the command: `fleet -e ENDPOINT list`."""
    name = param.name or ""
    at = ctx
    while at.parent is not None and at.get_parameter_source(name) is not ParameterSource.COMMANDLINE:
        at = at.parent
    return value if at is ctx or at.get_parameter_source(name) is not ParameterSource.COMMANDLINE else at.params[name]


def connect_option(
    words: str = "The bus, as tcp/HOST:PORT (default: FLEET_ENDPOINT, else the hub you joined, else port 7447 here).",
) -> _Decorator:
    """Return the option --connect with this help."""
    return click.option("-e", "--connect", "--endpoint", metavar="ENDPOINT", callback=_from_group, help=words)


def fleet_option(default: str | None = DEFAULT_FLEET) -> _Decorator:
    """Return the option --fleet. Without a default, the name comes from the fleet file."""
    words = "Name of the fleet." if default else f"Name of the fleet (default: the file's, or {DEFAULT_FLEET})."
    return click.option("--fleet", metavar="NAME", default=default, show_default=True, callback=_from_group, help=words)


def remember_fleet(connect: str | None, fleet: str) -> None:
    """Remember with which options the user reaches the fleet. Commands that messages propose get the same options."""
    click.get_current_context().meta[_BUS] = connect, fleet
    if is_fleet_named():
        name_fleet_in_hints()


def name_fleet_in_hints() -> None:
    """From now on, name even the default fleet in proposed commands: there are several fleets, or the user named it."""
    click.get_current_context().meta[_NAMED] = True


def is_fleet_named() -> bool:
    """Return True if the user has named the fleet of the running command."""
    at: click.Context | None = click.get_current_context()
    while at is not None:
        if at.get_parameter_source("fleet") not in (None, ParameterSource.DEFAULT):
            return True
        at = at.parent
    return False


def hint_options(fleet: str = "") -> str:
    """Return the options that a proposed command needs. `fleet` is empty for the running command's own fleet."""
    context = click.get_current_context(silent=True)
    known = context.meta if context is not None else {}
    connect, chosen = known.get(_BUS, (None, DEFAULT_FLEET))
    return fleet_options(connect, fleet or chosen, is_one_of_several=known.get(_NAMED, False))


def say(words: str, *, err: bool = False, fleet: str = "") -> None:
    """Print a text for a person. Add to each command that it proposes the options that the command needs."""
    click.echo(complete_hints(words, hint_options(fleet)), err=err)


def starter_option() -> _Decorator:
    """Return the hidden option --parent, which a starting process adds with `schemas.process.parent.parent_option`."""
    words = "End when this process ends: it started this one."
    return click.option("--parent", "starter", metavar="PID", type=int, hidden=True, help=words)


def as_option(complete: Callable[..., list[str]] | None = None) -> _Decorator:
    """Return the option --as, which may stand before or after the command. `chosen_person` returns its value."""
    return click.option(
        "--as",
        metavar="PERSON",
        expose_value=False,
        callback=_choose_person,
        shell_complete=complete,
        help="Who you are: a person in the fleet file (default: FLEET_AS, or your login).",
    )


def _choose_person(ctx: click.Context, _: click.Parameter, value: str | None) -> None:
    if value is not None:
        try:
            ctx.meta[PERSON] = check_name(value, "person")
        except BadKey as error:
            raise click.UsageError(str(error), ctx) from None


def chosen_person() -> str | None:
    """Return the value of --as. None if it was not given."""
    person: str | None = click.get_current_context().meta.get(PERSON)
    return person
