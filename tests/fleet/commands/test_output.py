"""Columns of lists: aligned over all blocks, and for characters that take two columns or none."""

from itertools import chain, repeat

from fleet.commands.output import aligned


def test_columns_are_as_wide_as_their_widest_cell() -> None:
    assert list(aligned([("car", "mode"), ("red", "-"), ("车", "x"), ("é", "y")])) == [
        "car  mode",
        "red  -",
        "车   x",
        "é    y",
    ]
    assert list(aligned([])) == []


def test_later_block_narrows_no_column() -> None:
    lines = list(aligned(chain([("wide cell", "1")], repeat(("x", "2"), 3000), [("a wider cell", "3"), ("x", "4")])))
    assert {line.index("2") for line in lines if "2" in line} == {11, 14}
    assert lines[0].index("1") == 11
    assert (lines[-2].index("3"), lines[-1].index("4")) == (14, 14)
