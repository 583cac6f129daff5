"""`fleet example list | show | copy`: the programs, fleet files, plans and worlds that come with the package."""

import json
import re
from pathlib import Path
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from fleet.commands.command_group import CommandGroup
from fleet.commands.options import json_option
from fleet.commands.output import show_table
from fleet.examples import EXAMPLES
from schemas.suggestion import did_you_mean

_KINDS: Final = ("programs", "fleets", "plans", "worlds")
_SUFFIXES: Final = (".py", ".ipynb", ".yaml")
# A fleet file of the package names its plan and world with their folders. All copies are in one folder, so the copied
# fleet file names them without a folder.
_OTHER_FILE: Final = re.compile(r"\.\./((?:plans|worlds)/[\w.-]+\.yaml)")


def examples() -> dict[str, Path]:
    """Return the examples by name: the name of the file without its suffix."""
    files = (path for kind in _KINDS for path in sorted((EXAMPLES / kind).iterdir()))
    return {path.stem: path for path in files if path.suffix in _SUFFIXES and path.name != "__init__.py"}


def summary(path: Path) -> str:
    """Return the first line of an example, which describes it."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "".join(json.loads(text)["cells"][0]["source"])
    lines = (line for line in text.splitlines() if not line.startswith("# yaml-language-server"))
    return next(lines).strip('#". ')


class ExampleName(click.ParamType[Path]):
    """The name of an example, such as `1-patrol`. The name of its file is accepted, too: `plans/1-patrol.yaml`."""

    name = "NAME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:  # noqa: ARG002 - click's signature
        """Return the path of the example. If there is no such example, fail with the likely name."""
        if isinstance(value, Path):
            return value
        known = examples()
        name = Path(str(value)).stem
        if name not in known:
            near = did_you_mean(name, known) or "`fleet example list` shows all."
            raise click.UsageError(f'There is no example "{name}". {near}', ctx)
        return known[name]

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002 - click's signature
        """Complete the name."""
        return [CompletionItem(name) for name in examples() if name.startswith(incomplete)]


name_argument = click.argument("path", type=ExampleName(), metavar="NAME")


@click.group(
    cls=CommandGroup,
    epilog="\b\nexamples:\n  fleet example list\n  fleet example show 1-patrol\n  fleet example copy 1-patrol",
)
def example() -> None:
    """Show and copy example programs, fleet files, plans and worlds."""


@example.command("list", epilog="\b\nexamples:\n  fleet example list\n  fleet example list --json")
@json_option
def list_examples(*, as_json: bool) -> None:
    """List the examples with their kind."""
    rows = [
        {"name": name, "kind": path.parent.name.removesuffix("s"), "about": summary(path)}
        for name, path in examples().items()
    ]
    if as_json:
        for row, path in zip(rows, examples().values(), strict=True):
            click.echo(json.dumps({**row, "file": str(path)}))
    else:
        show_table(("name", "kind", "about"), rows)


@example.command(epilog="\b\nexample:\n  fleet example show 1-patrol")
@name_argument
def show(path: Path) -> None:
    """Print an example."""
    click.echo(path.read_text(encoding="utf-8"), nl=False)


@example.command(epilog="\b\nexamples:\n  fleet example copy 1-patrol\n  fleet example copy sim lab --force")
@name_argument
@click.argument("directory", default=Path(), type=click.Path(path_type=Path, file_okay=False), metavar="[DIR]")
@click.option("--force", is_flag=True, help="Overwrite existing files.")
def copy(path: Path, directory: Path, *, force: bool) -> None:
    """Copy an example into DIR (default: here). With a fleet file, also copy the plan and the world that it names."""
    if directory.suffix == path.suffix:  # otherwise a directory with the name plan.yaml would be created
        raise click.UsageError(f"{directory} is the name of a file: give a directory, or nothing for the current one")
    text = path.read_text(encoding="utf-8")
    copies = {directory / path.name: _OTHER_FILE.sub(lambda match: Path(match[1]).name, text)}
    others = _OTHER_FILE.findall(text) if path.parent.name == "fleets" else ()
    for other in others:
        copies[directory / Path(other).name] = (EXAMPLES / other).read_text(encoding="utf-8")
    for target in copies:
        if target.exists() and not force:
            raise click.UsageError(f"{target} exists already: give --force to overwrite it, or another directory")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for target, content in copies.items():
            target.write_text(content, encoding="utf-8")
            click.echo(f"wrote {target}")
    except OSError as error:
        raise click.ClickException(f"{error.filename} cannot be written: {error.strerror}") from None
