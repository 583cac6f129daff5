"""Colors: their names, the parser of `red` and `#ff0000`, and the colors of cars in every view. Pure."""

import re
from collections.abc import Mapping
from typing import Final

from schemas.suggestion import did_you_mean

Rgb = tuple[int, int, int]
"""Red, green and blue, 0 to 255 each."""

COLORS: Final[Mapping[str, Rgb]] = {
    "red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "yellow": (255, 255, 0), "orange": (255, 120, 0),
    "cyan": (0, 255, 255), "magenta": (255, 0, 255), "purple": (140, 0, 255), "pink": (255, 80, 150),
    "brown": (150, 75, 0), "gray": (128, 128, 128), "white": (255, 255, 255), "black": (0, 0, 0), "off": (0, 0, 0),
}  # fmt: skip
COLOR_PATTERN: Final = f"^({'|'.join(COLORS)}|#[0-9a-fA-F]{{6}})$"

# For cars that are named after a color. The shades are not those of COLORS: a black car is drawn in gray.
_CAR_COLORS: Final[Mapping[str, Rgb]] = {
    "red": (235, 80, 80), "green": (90, 200, 110), "blue": (90, 150, 250), "yellow": (235, 205, 70),
    "orange": (245, 150, 60), "white": (230, 230, 230), "black": (130, 130, 130), "pink": (245, 130, 190),
    "violet": (150, 110, 240), "purple": (150, 110, 240), "cyan": (80, 200, 200), "magenta": (220, 110, 220),
    "brown": (170, 120, 80), "gray": (160, 160, 160),
}  # fmt: skip
_OTHER_CAR_COLORS: Final[tuple[Rgb, ...]] = (
    (80, 200, 200), (190, 130, 240), (245, 150, 60), (160, 200, 80), (230, 120, 160), (120, 160, 200),
)  # fmt: skip


def parse_color(text: str) -> Rgb:
    """Return the color of a name, of `#rrggbb`, or of `rrggbb`. Raises ValueError for another text."""
    if text in COLORS:
        return COLORS[text]
    match = re.fullmatch(r"#?([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", text)
    if match is not None:
        return int(match[1], 16), int(match[2], 16), int(match[3], 16)
    hint = "Write # and six of 0-9 and a-f, as '#ff8000'." if text.startswith("#") else ""
    hint = hint or ("Write red, green and blue as one color: '#ff8000' is 255, 128, 0." if text.isdecimal() else "")
    hint = hint or did_you_mean(text, COLORS) or f"Choose from: {', '.join(COLORS)}, or write '#ff8000'."
    raise ValueError(f'"{text[:40]}" is not a color. {hint}')


def format_color(color: Rgb) -> str:
    """Return a color's name, or `#rrggbb` if it has none."""
    named = (name for name, rgb in COLORS.items() if rgb == color)
    return next(named, hex_color(color))


def hex_color(color: Rgb) -> str:
    """Return a color as `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def car_color(car: str, index: int) -> Rgb:
    """Return the color of a car in every view: the color that the car is named after, else one by its index."""
    return _CAR_COLORS.get(car, _OTHER_CAR_COLORS[index % len(_OTHER_CAR_COLORS)])
