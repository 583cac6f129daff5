"""Reads fields of messages whose schema may be foreign: it may lack a field, or give it another type. Pure."""

from typing import Any


def text_of(message: Any, name: str) -> str:
    """Return a field as text. Empty if the schema lacks it."""
    return str(getattr(message, name, ""))


def number_of(message: Any, name: str) -> int:
    """Return a whole number. 0 if the schema lacks it, or has something else under this name."""
    number = getattr(message, name, 0)
    return number if isinstance(number, int) else 0
