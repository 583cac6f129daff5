"""The pages of the commands: click's parameters for `fleet`, argparse's actions for `gateway`."""

import argparse
import importlib
import re
from collections.abc import Iterator

import click

import gateway.cli
from fleet.cli import COMMANDS, cli

_HIDDEN = {"help"}
GATEWAY = "gateway" + ".md"
_EXAMPLES = re.compile(r"examples?:")


def pages() -> dict[str, str]:
    """Return the text of each page by the name of its file."""
    made = {name: _page(command, name) for name, command in commands()}
    return {f"{name}.md": text for name, text in {"index": _index(), "gateway": _gateway_page(), **made}.items()}


def commands() -> Iterator[tuple[str, click.Command]]:
    """Yield every command of `fleet` that its help lists."""
    context = click.Context(cli, info_name="fleet")
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None
        if not command.hidden:
            yield name, command


def subcommands(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """Yield a command and its subcommands, with their words on the command line."""
    yield name, command
    if isinstance(command, click.Group):
        for below in command.list_commands(click.Context(command)):
            each = command.get_command(click.Context(command), below)
            if each is not None and not each.hidden:
                yield from subcommands(f"{name} {below}", each)


def options(command: click.Command) -> list[click.Parameter]:
    """Return the parameters that the help shows."""
    return [each for each in command.params if not getattr(each, "hidden", False) and each.name not in _HIDDEN]


def _index() -> str:
    rows = [
        "# The `fleet` command",
        "",
        "Each command has a page with its options and examples. `fleet COMMAND --help` prints the same.",
        "The exit code is 0 if all was carried out, 1 if not, 2 for wrong use, and 130 after Ctrl-C.",
        f"[`gateway`]({GATEWAY}) connects one car to the fleet, and helps with a car on the desk.",
    ]
    for heading, names in headings().items():
        rows += ["", f"## {heading}", "", "| command | what it does |", "|---|---|"]
        rows += [f"| [`{name}`]({name}.md) | {cell(COMMANDS[heading][name][1])} |" for name in names]
    return "\n".join(rows) + "\n"


def headings() -> dict[str, list[str]]:
    """Return the commands below each heading of `fleet --help`."""
    listed = {name for name, _ in commands()}
    return {heading: [name for name in rows if name in listed] for heading, rows in COMMANDS.items()}


def _page(command: click.Command, name: str) -> str:
    """Return a page: the command, then the subcommands of a group."""
    parts = []
    for words, each in subcommands(name, command):
        level = "#" if words == name else "##"
        parts.append(f"{level} fleet {words}\n\n{_body(words, each)}")
    if name in gateway.cli.COMMANDS:
        parts.append(f"[`gateway {name}`]({GATEWAY}#gateway-{name}) does the same.")
    return "\n\n".join(parts) + "\n"


def _body(words: str, command: click.Command) -> str:
    context = click.Context(command, info_name=f"fleet {words}")
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    parts = [_prose(command.help or ""), f"```text\n{usage}\n```"]
    if isinstance(command, click.Group):
        below = [f"`{each}`" for each in command.list_commands(context)]
        parts.append(f"Commands below it: {', '.join(below)}.")
    if rows := [_option_row(each, context) for each in options(command) if isinstance(each, click.Option)]:
        parts.append("\n".join(["| option | default | what it does |", "|---|---|---|", *rows]))
    parts.append(_prose(command.epilog or ""))
    return "\n\n".join(part for part in parts if part)


def _option_row(option: click.Option, context: click.Context) -> str:
    names = "`, `".join([*sorted(option.opts, key=len), *option.secondary_opts])
    metavar = "" if option.is_flag or option.count else f" {option.make_metavar(context)}"
    extra = option.get_help_extra(context)
    default = extra.get("default", "required" if option.required else "")
    limits = f" Range: {extra['range']}." if "range" in extra else ""
    more = " Repeatable." if option.multiple and "Repeatable" not in (option.help or "") else ""
    shown = f"`{default}`" if default and default != "required" else default
    return f"| `{names}{metavar}` | {shown} | {cell((option.help or '') + limits + more)} |".replace("`, `-", "`, `-")


def cell(text: str) -> str:
    """Return text for a cell of a table."""
    return escape(" ".join(text.split())).replace("|", "\\|")


def escape(text: str) -> str:
    """Return text in which Markdown finds no markup but code in backquotes."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*\[\]])", r"\\\1", part).replace("<", "&lt;") for part in parts
    )


def _prose(text: str) -> str:
    """Return help as Markdown. Examples and other verbatim parts become blocks of code."""
    made = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        lines = [line for line in paragraph.splitlines() if line.strip() != "\b"]
        as_it_is = len(lines) < len(paragraph.splitlines())
        if not lines:
            continue
        if _EXAMPLES.fullmatch(lines[0].strip()):
            made.append("Examples:\n\n```sh\n" + "\n".join(line.strip() for line in lines[1:]) + "\n```")
        elif as_it_is and len(lines) > 1:
            made.append("```text\n" + "\n".join(lines) + "\n```")
        else:
            made.append(escape(" ".join(" ".join(lines).split())))
    return "\n\n".join(made)


def gateway_parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of each command of `gateway`."""
    parser = argparse.ArgumentParser(prog="gateway")
    below = parser.add_subparsers()
    gateway.cli._add_run(below)
    for name, (module, words) in gateway.cli.COMMANDS.items():
        importlib.import_module(module).add_arguments(below.add_parser(name, help=words))
    return dict(below.choices)


def _gateway_page() -> str:
    parts = [
        "# The `gateway` command",
        (
            "`gateway` is for one car: it connects the car to the fleet, and helps with a car on the desk. "
            "`fleet up` starts `gateway run` for every car, so most people never type it."
        ),
    ]
    for name, parser in gateway_parsers().items():
        rows = ["| option | default | what it does |", "|---|---|---|"]
        rows += [_action_row(each) for each in parser._actions if shown_action(each)]
        parts += [f"## gateway {name}", cell(parser.description or ""), "\n".join(rows)]
        if parser.epilog:
            parts.append(f"```text\n{parser.epilog.strip()}\n```")
    return "\n\n".join(part for part in parts if part) + "\n"


def shown_action(action: argparse.Action) -> bool:
    """Return True if the help shows this argument."""
    return action.help != argparse.SUPPRESS and action.dest != "help"


def _action_row(action: argparse.Action) -> str:
    names = "`, `".join(action.option_strings) or str(action.metavar or action.dest)
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else ""
    metavar = (
        "" if action.nargs == 0 or not action.option_strings else f" {action.metavar or choices or action.dest.upper()}"
    )
    silent = action.default in (None, False, argparse.SUPPRESS) or action.default == []
    default = "required" if action.required and action.option_strings else "" if silent else f"`{action.default}`"
    words = (action.help or "") % {"prog": "gateway", "default": action.default}
    if default and default != "required":
        words = re.sub(r" \(default: [^()]*\)", "", words)  # the column has it
    return f"| `{names}{metavar}` | {default} | {cell(words)} |"
