"""Makes foreign text fit for one line of a terminal. Pure.

Keys and texts of a recording are bytes of strangers: an escape sequence in them could rename the window, move the
cursor or type commands, and a key may be 65,535 bytes long.
"""

from typing import Final

MAX_PRINTED: Final = 120
"""Maximum characters of a key in a text."""


def printable(text: str, most: int = MAX_PRINTED) -> str:
    """Return text with control characters and invisible ones as escapes, and shortened to `most` characters."""
    shown = "".join(each if each.isprintable() else _escape(each) for each in text[: most + 1])
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


def printable_lines(text: str) -> str:
    """Return text of any length with all control characters as escapes, except the ends of lines and tabs."""
    return "".join(each if each.isprintable() or each in "\n\t" else _escape(each) for each in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii") if character > "\x7f" else f"\\x{ord(character):02x}"
