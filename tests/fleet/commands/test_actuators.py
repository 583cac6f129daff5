"""Subcommands that a row of the table of commands describes."""

from typing import Any

import click
import pytest
from click.testing import CliRunner

from fleet import cli
from fleet.commands import actuators
from schemas.commands import COMMANDS

PLAIN = [row for row in COMMANDS.values() if row.subcommand]
HORN = COMMANDS["whistle"]._replace(min_duration_s=0.5, max_duration_s=10.0, subcommand="horn")
"""A row with a duration. No verb of a car has one and needs no rules."""


@pytest.mark.parametrize("row", PLAIN, ids=lambda row: row.verb)
def test_row_is_the_subcommand(row: Any) -> None:
    listed = [names[row.subcommand] for names in cli.COMMANDS.values() if row.subcommand in names]
    assert listed == [(f"fleet.commands.actuators:{row.subcommand}", row.summary)]
    help_text = CliRunner().invoke(getattr(actuators, row.subcommand), ["--help"]).output
    assert row.summary in help_text
    assert f"fleet {row.subcommand} red\n" in help_text
    assert "--for" not in help_text


def test_row_with_a_maximum_duration_adds_an_option() -> None:
    horn: click.Command = actuators._plain_command(HORN)
    assert "fleet horn red --for 2s\n" in CliRunner().invoke(horn, ["--help"]).output
    wrong = [(["red", "--for", "11s"], "10s"), (["red", "--for", "400ms"], "500ms")]
    for words, error in (*wrong, (["red"], "--for"), (["--for", "2s"], "CAR...")):
        result = CliRunner().invoke(horn, words)
        assert (result.exit_code, error in result.output) == (2, True), result.output


def test_no_other_name_is_a_subcommand() -> None:
    with pytest.raises(AttributeError):
        _ = actuators.horn
