"""Columns that do not fit are left out or shortened, the optional ones first."""

import pytest

from fleet.column_widths import fit_columns


@pytest.mark.parametrize(
    ("width", "columns"),
    [
        (100, {"car": 5, "platform": 20, "mode": 30, "battery": 15}),
        (60, {"car": 5, "mode": 30, "battery": 15}),
        (40, {"car": 5, "mode": 16, "battery": 15}),
        (5, {"car": 4, "mode": 4, "battery": 4}),
    ],
)
def test_columns_are_dropped_in_order_then_widest_shortened(width: int, columns: dict[str, int]) -> None:
    assert fit_columns({"car": 5, "platform": 20, "mode": 30, "battery": 15}, width, ("platform",)) == columns
