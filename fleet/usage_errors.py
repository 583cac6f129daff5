"""The text of an error of a command line, and the command whose help it names."""

import re
import sys
from collections.abc import Mapping

import click

from schemas.suggestion import how_to_install, misspelled


def describe_missing_package(error: ModuleNotFoundError, extras: Mapping[str, str]) -> str:
    """Return a message about the missing package and how to install it.

    Raises the error again if the module is our own.
    """
    module = (error.name or "").partition(".")[0]
    if module in ("", "fleet", "gateway", "schemas"):
        raise error
    how = how_to_install(extras[module]) if module in extras else "pip install zenoh-car-fleet"
    return f"this command needs {module}, which is not installed. Type: {how}"


def command_path(error: click.UsageError, cli: click.Group) -> str:
    """Return the command that the error is about.

    Errors of click's parser do not contain it, so find it in the arguments.
    """
    if error.ctx is not None:
        return error.ctx.command_path
    path: list[str] = ["fleet"]
    command: click.Group = cli
    for word in sys.argv[1:]:
        found = command.get_command(click.Context(command), word)
        if found is not None:
            path.append(word)
            if not isinstance(found, click.Group):
                break
            command = found
    return " ".join(path)


def describe_error(error: click.ClickException, cli: click.Group) -> str:
    """Return the message on one line.

    The messages of our own parameter types already quote the wrong word, so the name of the argument is left out.
    """
    if isinstance(error, click.BadParameter) and not isinstance(error, click.MissingParameter):
        option = f"{error.param.opts[-1]}: " if isinstance(error.param, click.Option) else ""
        return " ".join(f"{option}{error.message}".split())
    if isinstance(error, click.NoSuchOption) and error.ctx is not None:
        # click also suggests names that are hardly similar, such as --as for --json.
        options = [each for param in error.ctx.command.get_params(error.ctx) for each in param.opts]
        near = misspelled(error.option_name.lstrip("-"), [each[2:] for each in options if each.startswith("--")])
        return f"No such option '{error.option_name}'.{f' Did you mean --{near[0]}?' if near else ''}"
    words = " ".join(error.format_message().split())
    extra = re.fullmatch(r"Got unexpected extra arguments? \((.*)\)", words)
    if extra is None or not isinstance(error, click.UsageError):
        return words
    return f'{command_path(error, cli)} does not accept "{extra[1]}".'
