"""The source files of the packages, each read and parsed once in a process."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
PRODUCT: Final = ("gateway", "fleet", "schemas")
PACKAGES: Final = (*PRODUCT, "tests")
_GENERATED: Final = ROOT / "schemas" / "gen"
GROUP: Final = "sources"
"""The tests that read the sources, on one worker."""


def source_files(*packages: str) -> Iterator[Path]:
    """Yield the files of these packages by name, except generated ones."""
    for package in packages:
        yield from (path for path in sorted((ROOT / package).rglob("*.py")) if _GENERATED not in path.parents)


@cache
def text(path: Path) -> str:
    """Return the text of a source file."""
    return path.read_text(encoding="utf-8")


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a source file."""
    return ast.parse(text(path))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of a file's syntax tree, in the order of `ast.walk`."""
    return tuple(ast.walk(parsed(path)))
