"""The names of platforms as users write them: `arduino`, `raspberry_pi+arm+imu`, `stm32+head=BALA`, `auto`."""

# A gateway checks the name before it joins the bus. Importing the profiles for that would take 10 ms.

import re
from typing import Final

from schemas.suggestion import did_you_mean
from schemas.words import Platform

OPTIONS: Final = frozenset({"arm", "imu"})
"""Options that add a part to a car."""
# Programs of one family differ in these (docs/reference/protocol.md#programs-that-people-have).
NO_READINGS: Final = "no_readings"
VARIANTS: Final = ("text", NO_READINGS, "3s", "fan_level", "ptz_direct")
"""Options that say how this car's program differs from the others."""
HEAD: Final = "head"
"""The option with a value, which is the first word of the car's frames."""
HEAD_PATTERN: Final = "[A-Za-z0-9]{2,8}"
AUTO: Final = "auto"
AUTO_PLATFORMS: Final = tuple(str(kind) for kind in Platform if kind is not Platform.UNKNOWN)
"""The platforms that a gateway can recognize by itself."""

_KNOWN: Final = OPTIONS | frozenset(VARIANTS)
OPTION_WORDS: Final = ", ".join(f"+{option}" for option in (*sorted(OPTIONS), *VARIANTS, f"{HEAD}=WORD"))
"""All options, for the text of an error."""


def normalize_name(text: str) -> str:
    """Return a name in lower case. The value of the head stays as it is."""
    return "+".join(_normalize_part(part) for part in text.split("+"))


def kind_of(name: str) -> str:
    """Return a name without its options."""
    return name.partition("+")[0]


def parse_name(text: str) -> tuple[Platform, frozenset[str]]:
    """Return platform and options of a name such as `raspberry_pi+arm+imu`, in any case. Raises ValueError."""
    kind, *options = normalize_name(text).split("+")
    if kind not in set(Platform):
        hint = did_you_mean(kind, Platform) or f"There are {', '.join(Platform)}."
        raise ValueError(f'Unknown platform "{kind[:40]}". {hint}')
    for option in options:
        word, equals, value = option.partition("=")
        if word == HEAD and equals:
            check_head(value)
        elif option not in _KNOWN:
            raise ValueError(f'Unknown option "+{option[:40]}" of a platform. There are {OPTION_WORDS}.')
    chosen = frozenset(options)
    if sum(option.startswith(HEAD) for option in chosen) > 1:
        raise ValueError(f"A car has one head, so write one +{HEAD}=WORD.")
    return Platform(kind), chosen


def check_head(value: str) -> None:
    """Raise ValueError unless the value is allowed as the first word of a frame."""
    if not re.fullmatch(HEAD_PATTERN, value):
        raise ValueError(f'The head "{value[:40]}" is not allowed: use 2 to 8 letters and digits, as in +{HEAD}=4WD.')


def parse_option(text: str) -> tuple[str, bool]:
    """Return the name to start with, and True if the gateway detects the platform. Raises ValueError.

    `auto` starts as `unknown`.
    """
    name = normalize_name(text)
    auto = name.partition("+")[0] == AUTO
    if auto:
        name = name.replace(AUTO, Platform.UNKNOWN, 1)
    parse_name(name)
    return name, auto


def _normalize_part(part: str) -> str:
    word, equals, value = part.partition("=")
    return f"{word.lower()}{equals}{value if word.lower() == HEAD else value.lower()}"
