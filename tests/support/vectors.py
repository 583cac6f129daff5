"""Reads tests/vectors/*.tsv: one row per line of the tables of docs/reference/protocol.md.

The column `source` names the section and the row.
"""

from pathlib import Path

_VECTORS = Path(__file__).resolve().parents[1] / "vectors"


def rows(name: str) -> list[dict[str, str]]:
    """Return the rows of one file as dicts by column. Each row must have the header's columns and a source."""
    lines = (_VECTORS / f"{name}.tsv").read_text(encoding="utf-8").splitlines()
    header, *table = [line.split("\t") for line in lines if line and not line.startswith("// ")]
    assert "source" in header, name
    found = [dict(zip(header, row, strict=True)) for row in table]
    assert all(row["source"] for row in found), name
    return found


def ids(table: list[dict[str, str]]) -> list[str]:
    """Return the test ids: source and first column."""
    return [f"{row['source']}: {next(iter(row.values()))}" for row in table]


def wire(text: str) -> bytes:
    """Return the bytes of a cell. Python's escapes for control characters and bytes are allowed."""
    return text.encode("latin-1").decode("unicode_escape").encode("latin-1")
