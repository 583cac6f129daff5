"""Names of colors, and the reader of `red` and `#ff0000`, for LEDs and for cars in pictures. Pure."""

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


def parse_color(text: str) -> Rgb:
    """Return the color of a name or of `#rrggbb`; raises ValueError."""
    if text in COLORS:
        return COLORS[text]
    match = re.fullmatch(r"#?([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", text)
    if match is not None:
        return int(match[1], 16), int(match[2], 16), int(match[3], 16)
    hint = did_you_mean(text, COLORS) or f"Choose from: {', '.join(COLORS)}, or write '#ff8000'."
    raise ValueError(f'"{text[:40]}" is not a color. {hint}')


def format_color(color: Rgb) -> str:
    """Return a color's name, or `#rrggbb` if it has none."""
    named = (name for name, rgb in COLORS.items() if rgb == color)
    return next(named, f"#{color[0]:02x}{color[1]:02x}{color[2]:02x}")
