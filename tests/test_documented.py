"""Tests that docs/ describes all commands, options, fields of files, events, reasons and variables."""

import argparse
import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click
import pytest

from fleet.cli import cli
from fleet.client.diagnosis import CHECKS
from fleet.commands.params import Choice
from schemas.commands import COMMANDS
from schemas.words import Mode, Reason
from tests.support.sources import GROUP, PRODUCT, ROOT, nodes, source_files, text
from tests.tools.pages import files, proto
from tests.tools.pages.command_line import commands, gateway_parsers, options, shown_action, subcommands

DOCS: Final = ROOT / "docs"
SHELL: Final = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
FILE_BLOCK: Final = re.compile(r'^```yaml title="(fleet|plan|world)\.yaml"\n(.*?)^```', re.MULTILINE | re.DOTALL)
NO_EXAMPLE: Final = frozenset({"down", "status", "reload", "whistle"})
"""Commands without arguments, whose usage is their example."""
OURS: Final = re.compile(r"FLEET_\w+|_FLEET_COMPLETE")


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


LEAVES: Final = [each for name, command in commands() for each in subcommands(name, command)]


@pytest.mark.parametrize(("words", "command"), LEAVES, ids=[words for words, _ in LEAVES])
def test_each_command_has_an_example_and_each_option_its_words(words: str, command: click.Command) -> None:
    name = words.split(maxsplit=1)[0]
    page = read(f"docs/reference/cli/{name}.md")
    missing = [each.opts[0] for each in options(command) if isinstance(each, click.Option) and not each.help]
    assert missing == [], "options without help"
    choices = [word for each in options(command) if isinstance(each.type, Choice) for word in each.type.choices]
    assert [word for word in choices if word not in page] == []
    shown = [each.opts[0] for each in options(command) if isinstance(each, click.Option)]
    assert [option for option in shown if option not in page] == []
    if words not in NO_EXAMPLE and not isinstance(command, click.Group):
        assert re.search(rf"^fleet {words}\b", "\n".join(SHELL.findall(page)), re.MULTILINE), "no example"


def test_each_argument_of_gateway_has_its_words() -> None:
    page = read("docs/reference/cli/gateway.md")
    for parser in gateway_parsers().values():
        for action in parser._actions:
            if shown_action(action):
                assert action.help, action
                name = action.option_strings[0] if action.option_strings else str(action.metavar or action.dest)
                assert name in page, action


def shell_lines() -> Iterator[tuple[str, str]]:
    """Yield each command line of README and docs, with its page."""
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md"))):
        for block in SHELL.findall(path.read_text(encoding="utf-8")):
            for line in block.splitlines():
                for part in re.split(r"&&|;|\|", re.sub(r"\s+# .*|^#.*|\s{3,}.*", "", line)):
                    words = part.strip().removeprefix("FLEET_ENDPOINT=tcp/192.168.1.2:7447 ")
                    if words.startswith(("fleet ", "gateway ")):
                        yield str(path.relative_to(ROOT)), words


LINES: Final = sorted(set(shell_lines()))


@pytest.mark.parametrize(("page", "line"), LINES, ids=[line for _, line in LINES])
def test_each_documented_command_line_parses(page: str, line: str) -> None:
    program, *arguments = shlex.split(line.partition(" > ")[0])
    if program == "gateway" or arguments[0] == "sim":
        parser = gateway_parsers()[arguments[0]]
        parser.error = lambda message: pytest.fail(f"{page}: {line}: {message}")  # type: ignore[method-assign]
        assert isinstance(parser.parse_args(arguments[1:]), argparse.Namespace)
        return
    command: click.Command = cli
    context = click.Context(cli, info_name="fleet")
    try:
        while isinstance(command, click.Group) and not {*arguments} <= {"--version"}:
            command.parse_args(context, arguments)
            _, below, arguments = command.resolve_command(context, [*context._protected_args, *context.args])
            assert below is not None
            command, context = below, click.Context(below, context, info_name=below.name, **below.context_settings)
        command.make_parser(context).parse_args(list(arguments))
    except click.UsageError as error:
        pytest.fail(f"{page}: {line}: {error.message}")


@pytest.mark.parametrize(
    ("page", "schema"),
    [
        ("docs/reference/fleet-file.md", files.fleet_schema),
        ("docs/reference/plan-file.md", files.plan_schema),
        ("docs/reference/world-file.md", files.world_schema),
    ],
    ids=["fleet", "plan", "world"],
)
def test_each_field_of_a_file_is_described(page: str, schema: files.SchemaMaker) -> None:
    text = read(page)
    made = schema()
    for name, part in {"": made, **made.get("$defs", {})}.items():
        for field, each in part.get("properties", {}).items():
            assert f"| `{field}` |" in text, f"{name}.{field}"
            assert files.about(each), f"{name}.{field} has no description"


@pytest.mark.parametrize(
    ("path", "kind", "text"),
    [
        pytest.param(path, kind, text, id=f"{path.stem}-{index}")
        for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
        for index, (kind, text) in enumerate(FILE_BLOCK.findall(path.read_text(encoding="utf-8")), 1)
    ],
)
def test_each_file_in_the_docs_is_one_that_check_accepts(path: Path, kind: str, text: str, tmp_path: Path) -> None:
    (tmp_path / f"{kind}.yaml").write_text(text, encoding="utf-8")
    assert files.problems(kind, text) == [], path


def test_each_field_of_a_message_is_on_its_page() -> None:
    text = read("docs/reference/messages.md")
    for message in proto.read():
        assert f"### {message.name}\n" in text
        for name, _, _ in message.fields:
            assert f"`{name}`" in text or name in proto.COMMON_OF_COMMANDS, f"{message.name}.{name}"
    assert rows("docs/reference/commands.md", "Payload") >= proto.COMMON_OF_COMMANDS


def listed(page: str, heading: str) -> list[str]:
    """Return the first cells of the tables below a heading."""
    section = read(page).partition(f"## {heading}\n")[2].partition("\n## ")[0]
    return [
        name for cell in re.findall(r"^\| ([^|]+) \|", section, re.MULTILINE) for name in re.findall(r"`(\w+)`", cell)
    ]


def rows(page: str, heading: str) -> set[str]:
    """Return the first cells of the tables below a heading, without their order."""
    return set(listed(page, heading))


def test_each_reason_of_a_refusal_is_documented() -> None:
    assert rows("docs/reference/commands.md", "Results") == set(Reason)


def test_each_finding_of_the_doctor_is_documented_in_its_order() -> None:
    assert listed("docs/how-to/troubleshooting.md", "Ask the doctor") == [check.code for check in CHECKS]


def test_each_verb_and_each_mode_is_documented() -> None:
    assert set(COMMANDS) <= rows("docs/reference/commands.md", "Verbs")
    assert rows("docs/reference/modes.md", "What a car reports in a mode") >= set(Mode)


def log_codes() -> Iterator[str]:
    """Yield the code of each event that a gateway logs: the argument after the level."""
    for path in source_files("gateway"):
        if "Level." not in text(path):
            continue
        for node in nodes(path):
            if isinstance(node, ast.Call) and len(node.args) >= 3 and "Level." in ast.unparse(node.args[0]):
                code = node.args[1]
                if isinstance(code, ast.Constant) and isinstance(code.value, str):
                    yield code.value
                elif isinstance(code, ast.JoinedStr):  # f"battery_{level}"
                    yield ast.unparse(code)[2:-1].partition("{")[0]
        for node in nodes(path):
            if isinstance(node, ast.Call) and "severity.get" in ast.unparse(node.args[0] if node.args else node.func):
                yield ast.unparse(node.args[1])[2:-1].partition("{")[0]


@pytest.mark.xdist_group(GROUP)
def test_each_event_is_documented() -> None:
    documented = rows("docs/reference/events.md", "Codes of a gateway")
    logged = set(log_codes())
    assert {"link_lost", "not_shown"} <= logged
    prefixes = tuple(code for code in logged if code.endswith("_"))
    assert {code for code in logged - set(prefixes) if code not in documented} == set()
    assert {code for code in documented - logged if not code.startswith(prefixes)} == set(), "events that are gone"


def environment_variables() -> Iterator[str]:
    """Yield each variable that the code reads, and each of the fleet's own variables that the code names."""
    for path in source_files(*PRODUCT):
        reads = "os." in text(path)
        for node in nodes(path):
            words = ast.unparse(node) if reads and isinstance(node, ast.Call | ast.Subscript) else ""
            if found := re.match(r"os\.(?:environ(?:\.get\(|\.setdefault\(|\[)|getenv\()'(\w+)'", words):
                yield found[1]
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and OURS.fullmatch(node.value):
                yield node.value


@pytest.mark.xdist_group(GROUP)
def test_each_environment_variable_is_documented() -> None:
    found = set(environment_variables())
    assert {"FLEET_ENDPOINT", "FLEET_STATE_DIR"} <= found
    assert found - rows("docs/reference/environment.md", "Environment variables") == set()
