"""A color has a name or #rrggbb, and a car has one color in every view."""

from schemas.colors import COLORS, car_color, format_color, hex_color, parse_color


def test_color_is_read_as_it_is_written() -> None:
    assert [format_color(parse_color(text)) for text in ("red", "#ff8000", "ff8000")] == ["red", "#ff8000", "#ff8000"]


def test_car_color_is_by_name_or_place() -> None:
    assert [name for name in COLORS if car_color(name, 0) != car_color(name, 5)] == ["off"], "off is no color of a car"
    assert len({hex_color(car_color(f"car{index}", index)) for index in range(6)}) == 6
