"""Parses and formats durations as users write them: `500ms`, `2s`, `1m30s`, `1h`, or a number of seconds. Pure."""

import re
from typing import Final

_UNITS_MS: Final = {"h": 3_600_000, "m": 60_000, "s": 1000, "": 1000, "ms": 1}
_LONG_UNITS: Final = {
    "millisecond": "ms", "msec": "ms", "s": "s", "sec": "s", "second": "s",
    "m": "m", "min": "m", "minute": "m", "h": "h", "hr": "h", "hour": "h",
}  # fmt: skip
_NUMBER: Final = r"\d+(?:\.\d*)?|\.\d+"
_DURATION: Final = re.compile(rf"(?:(?:{_NUMBER})(?:ms|h|m|s))+|(?:{_NUMBER})", re.ASCII)
DURATION_PATTERN: Final = f"^({_DURATION.pattern})$"
"""The pattern of a duration, for schemas of files."""
_WORDY: Final = re.compile(rf"({_NUMBER}) ?([a-z]+?)s?", re.ASCII)
_PART: Final = re.compile(rf"({_NUMBER})(ms|h|m|s|)", re.ASCII)


def duration_s(text: str) -> float | None:
    """Return the duration in seconds. None if the text is not a duration."""
    if not _DURATION.fullmatch(text):
        return None
    return sum(float(number) * _UNITS_MS[unit] for number, unit in _PART.findall(text)) / 1000


def parse_duration(text: str, min_s: float = 0.0, max_s: float | None = None) -> float:
    """Return the duration in seconds. Raises ValueError outside the range, for 0, and for any other text."""
    seconds = duration_s(text)
    if seconds is None:
        likely = _likely_duration(text) or "it as 500ms, 2s, 1m30s or 1h"
        raise ValueError(f'"{text}" is not a duration: write {likely}')
    if seconds < min_s or not seconds:
        raise ValueError(f"{text} is too short: {f'at least {format_duration(min_s)}' if min_s else 'more than 0'}")
    if max_s is not None and seconds > max_s:
        raise ValueError(f"{text} is too long: at most {format_duration(max_s)}")
    return seconds


def _likely_duration(text: str) -> str:
    """Return the duration that a text such as `2sec` or `5 min` means. Empty if unknown."""
    match = _WORDY.fullmatch(text.lower())
    unit = match and _LONG_UNITS.get(match[2])
    return f"{match[1]}{unit}" if match and unit else ""


def format_duration(seconds: float) -> str:
    """Return a duration with its largest whole unit: 500ms, 90s, 10m, 24h."""
    for unit in ("h", "m", "s"):
        if seconds * 1000 % _UNITS_MS[unit] == 0:
            return f"{seconds * 1000 / _UNITS_MS[unit]:g}{unit}"
    return f"{seconds * 1000:g}ms" if seconds < 1 else f"{seconds:g}s"
