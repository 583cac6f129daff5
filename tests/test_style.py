"""Tests rules of names, imports and messages that no linter has. CONTRIBUTING.md explains them."""

import ast
import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.support.message_length import MAX_LINES, count_lines
from tests.support.sources import GROUP, PACKAGES, PRODUCT, ROOT, nodes, parsed, source_files

pytestmark = pytest.mark.xdist_group(GROUP)

TWINS = frozenset({"Fleet", "Car", "Lease", "Watch"})
"""Classes of the SDK that have an asyncio twin of the same name in fleet/aio.py."""

POSIX = frozenset({"fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"})
"""Modules of the standard library that exist on POSIX systems only."""

LAZY_IMPORTS = 143
"""Maximum number of imports inside functions. Each of them shortens the start of a command line."""


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_class_name_stands_for_one_class() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for path in source_files(*PACKAGES):
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(module_name(path))
    for name in TWINS:
        places[name] = [each for each in places[name] if each != "fleet.aio"]
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def number(node: ast.expr) -> float | None:
    """Return the value of a literal number, also of a negated one."""
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def constants(path: Path) -> Iterator[tuple[str, float]]:
    for node in parsed(path).body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            value = number(node.value)
            if node.target.id.isupper() and value is not None:
                yield node.target.id.lstrip("_"), value


def test_constants_of_one_name_have_one_value() -> None:
    values: dict[str, dict[str, float]] = defaultdict(dict)
    for path in source_files(*PRODUCT):
        for name, value in constants(path):
            values[name][module_name(path)] = value
    assert {name: where for name, where in values.items() if len(set(where.values())) > 1} == {}


@cache
def imports(path: Path, *, lazy: bool) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """Return the imports at a module's top, or those inside functions. Skip imports for type checkers."""
    found = [node for node in nodes(path) if isinstance(node, ast.Import | ast.ImportFrom)]
    functions = [node for node in nodes(path) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    typing_only = [
        node for node in nodes(path) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    ]
    inside, left_out = lines_of(functions), lines_of(typing_only)
    return tuple(node for node in found if node.lineno not in left_out and (node.lineno in inside) == lazy)


def lines_of(blocks: Iterable[ast.stmt]) -> set[int]:
    """Return the numbers of all lines of these statements."""
    return {line for block in blocks for line in range(block.lineno, (block.end_lineno or block.lineno) + 1)}


def imported(path: Path) -> Iterator[str]:
    """Yield the names of all modules that a module may import at its top."""
    for node in imports(path, lazy=False):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def stray_texts(path: Path) -> Iterator[str]:
    """Yield the texts that document nothing: neither the first statement of a body, nor after an assignment."""
    for node in nodes(path):
        body = getattr(node, "body", None)
        for before, statement in itertools.pairwise(body if isinstance(body, list) else ()):
            if isinstance(statement, ast.Expr) and not isinstance(before, ast.Assign | ast.AnnAssign | ast.Assert):
                value = statement.value
                if isinstance(value, ast.JoinedStr) or (isinstance(value, ast.Constant) and value.value is not ...):
                    yield f"{module_name(path)}:{statement.lineno}"


def test_text_is_never_a_statement_of_its_own() -> None:
    """A message of two parts had lost its second one: the parenthesis was closed too early."""
    assert [each for path in source_files(*PACKAGES) for each in stray_texts(path)] == []


def test_posix_modules_are_imported_only_where_the_system_has_them() -> None:
    """Windows has none of them. Such an import stands in a function, in `try`, or behind a look at the system."""
    found = [
        f"{module_name(path)}: {alias.name}"
        for path in source_files(*PRODUCT)
        for node in parsed(path).body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in ([ast.alias(node.module or "")] if isinstance(node, ast.ImportFrom) else node.names)
        if alias.name in POSIX
    ]
    assert found == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    files = {module_name(path): path for path in source_files(*PRODUCT)}
    # A package imports its modules to export their names. Such imports make no cycle.
    packages = {name for name, path in files.items() if path.name == "__init__.py"}
    graph = {
        name: {each for each in imported(path) if each in files and each not in packages and each != name}
        for name, path in files.items()
    }
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        if name in way:
            pytest.fail("imports in a circle: " + " -> ".join((*way[way.index(name) :], name)))
        if name not in done:
            for each in sorted(graph[name]):
                visit(each, (*way, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_no_more_imports_are_lazy() -> None:
    lazy = [
        f"{module_name(path)}:{node.lineno}: {ast.unparse(node)}"
        for path in source_files(*PRODUCT)
        for node in imports(path, lazy=True)
    ]
    assert len(lazy) <= LAZY_IMPORTS, "\n".join(lazy)


def messages_with_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of all strings but docstrings and help. A value in a text counts as 12 letters."""
    no_message: set[int] = set()
    for node in nodes(path):
        if isinstance(node, ast.Expr) or (isinstance(node, ast.keyword) and node.arg in ("epilog", "help")):
            no_message |= {
                id(each) for each in ast.walk(node.value) if isinstance(node, ast.keyword) or each is node.value
            }
        elif isinstance(node, ast.JoinedStr):
            no_message |= {id(each) for each in node.values}
            if id(node) not in no_message:
                yield (
                    node.lineno,
                    "".join(
                        getattr(each, "value", "") if isinstance(each, ast.Constant) else "X" * 12
                        for each in node.values
                    ),
                )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in no_message:
            yield node.lineno, node.value


def test_message_to_users_has_at_most_two_lines() -> None:
    """Lists of a file's faults and changes are exempt, because no constant holds them."""
    raised = ("ClickException", "UsageError", "BadParameter", ".fail", ".echo", "stderr.write")
    faults = []
    for path in source_files(*PRODUCT):
        for line, text in messages_with_lines(path):
            if "\n" not in text and count_lines(text) > MAX_LINES:
                faults.append(f"{path}:{line}: {text}")
        for node in nodes(path):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(raised):
                strings = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant)]
                words = "".join(each for each in strings if isinstance(each, str) and each.strip())
                assert words.strip().count("\n") < 2, f"{path}:{node.lineno}"
    assert faults == []
