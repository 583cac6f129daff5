"""A proposed command has what it needs to reach the fleet of whom it is proposed to."""

import click
import pytest

from fleet.cli import cli
from fleet.client.hints import WITHOUT_FLEET, complete_command, complete_hints

TWO = "--connect tcp/10.0.0.2:7447 --fleet two"


@pytest.mark.parametrize(
    ("command", "completed"),
    [
        ("fleet stop red", "fleet stop red --fleet two"),
        ("fleet down", "fleet down --fleet two"),
        ("fleet plan restart", "fleet plan restart --fleet two"),
        ("fleet plan try", "fleet plan try"),
        ("fleet scan", "fleet scan"),
        ("fleet sessions recover", "fleet sessions recover"),
        ("fleet up --fleet three", "fleet up --fleet three"),
    ],
)
def test_command_that_reaches_a_fleet_gets_its_options(command: str, completed: str) -> None:
    assert complete_command(command, "--fleet two") == completed
    assert complete_command(command, "") == command
    assert complete_hints(f"First `{command}`, then `fleet down`.", "--fleet two") == (
        f"First `{completed}`, then `fleet down --fleet two`."
    )


def test_only_commands_in_backticks_are_completed() -> None:
    assert complete_hints("the fleet stop red, `red`, `gateway run`", TWO) == "the fleet stop red, `red`, `gateway run`"
    assert complete_hints("`fleet up`", TWO) == f"`fleet up {TWO}`"


def test_exactly_the_commands_without_the_option_get_none() -> None:
    def without(command: click.Command, path: tuple[str, ...]) -> set[str]:
        if isinstance(command, click.Group):
            context = click.Context(command)
            found = [(name, command.get_command(context, name)) for name in command.list_commands(context)]
            inner = [without(each, (*path, name)) for name, each in found if each is not None]
            whole = all(len(each) == 1 for each in inner)
            return {path[0]} if whole and path else set().union(*inner)
        return set() if any(each.name == "fleet" for each in command.params) else {" ".join(path)}

    assert without(cli, ()) == WITHOUT_FLEET
