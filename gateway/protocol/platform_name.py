"""The names of platforms as users write them: `arduino`, `raspberry_pi+arm+imu`, `auto`."""

# A gateway checks the name before it joins the bus. The profiles would delay that by 10 ms.

from enum import StrEnum
from typing import Final

from schemas.suggestion import did_you_mean


class Platform(StrEnum):
    """The program that runs on a car."""

    ARDUINO = "arduino"
    STM32 = "stm32"
    RASPBERRY_PI = "raspberry_pi"
    UNKNOWN = "unknown"


OPTIONS: Final = frozenset({"arm", "imu", "no_readings"})
AUTO: Final = "auto"


def parse_name(text: str) -> tuple[Platform, frozenset[str]]:
    """Return platform and options of a name such as `raspberry_pi+arm+imu` in any case; raise ValueError."""
    kind, *options = text.lower().split("+")
    if kind not in set(Platform):
        hint = did_you_mean(kind, Platform) or f"There are {', '.join(Platform)}."
        raise ValueError(f'Unknown platform "{kind[:40]}". {hint}')
    for option in options:
        if option not in OPTIONS:
            raise ValueError(f'Unknown option "+{option[:40]}" of a platform. There are +arm and +imu.')
    return Platform(kind), frozenset(options)


def parse_option(text: str) -> tuple[str, bool]:
    """Return the name to start with, and True if the gateway detects the platform. Raises ValueError.

    `auto` starts as `unknown`.
    """
    name = text.lower()
    auto = name.partition("+")[0] == AUTO
    if auto:
        name = name.replace(AUTO, Platform.UNKNOWN, 1)
    try:
        parse_name(name)
    except ValueError as error:
        raise ValueError(f"{error} Leave it out to detect it.") from None
    return name, auto
