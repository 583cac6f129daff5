"""Parses the options of a simulated car, such as `+3s` or `+interval=0.7`, into its traits. Pure.

Traits are the ways in which the program of one car differs from others of its platform.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

from msgspec.structs import replace

from gateway.sim.model.stm32 import STM32_TRAITS
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.ugv import UGV_BUILDS
from schemas.platform_name import HEAD, OPTION_WORDS, OPTIONS, VARIANTS, check_head
from schemas.words import Mode, Platform

FLAGS: Final[Mapping[str, Mapping[str, Any]]] = {
    "text": {"text": True},
    "no_readings": {"readings": False},
    "3s": {"cells": 3},
    "fan_level": {"fan_level": True},
    "ptz_direct": {"ptz_direct": True},
    "timer": {"timer": True},
    "last_frame": {"last_frame_wins": True},
    "constants": {"constants": True},
}
"""The traits that each option without a value sets."""
NUMBERS: Final[Mapping[str, tuple[str, float, float, str]]] = {
    "interval": ("interval_s", 0.1, 10.0, "a number of seconds"),
    "spread": ("spread_s", 0.0, 1.0, "a number of seconds"),
    "close": ("close_s", 0.0, 10.0, "a number of seconds"),
    "gray": ("gray_max", 1, 65535, "a whole number"),
}
"""For each option with a number: its trait, the smallest and the largest value, and the words for an error message."""
SILENT: Final = "silent"

_REPORTS: Final = ("interval", "spread")
_MODE_CAR: Final = (*_REPORTS, SILENT, "gray", "constants")
SIMULATED: Final[Mapping[str, tuple[str, ...]]] = {
    "arduino": (*_MODE_CAR, "timer", "close", "last_frame"),
    "stm32": _MODE_CAR,
    "raspberry_pi": _REPORTS,
    "course": (),
}
"""For each platform the options that exist only in the simulator."""
UGV_OPTIONS: Final = ("mission", "no_encoder", "quiet", "arm", "gimbal")
"""The options of the cars of Waveshare's UGV family: see `UgvCar`."""
_PLACEHOLDERS: Final = {"interval": "S", "spread": "S", "close": "S", "gray": "MAX", SILENT: "MODE"}


class BadOption(ValueError):
    """An option that is not allowed. The message says what is allowed instead."""


def parse_traits(platform: str, options: Iterable[str]) -> CarTraits | None:
    """Return the traits of a car, or None if they are those of its platform. Raises BadOption for a wrong option."""
    if platform in UGV_BUILDS:
        chosen = list(options)
        for option in chosen:
            if option not in UGV_OPTIONS:
                raise BadOption(f"option '+{option}' of {platform} is not allowed: use {allowed_options(platform)}")
        if {"arm", "gimbal"} <= set(chosen):
            raise BadOption(f"{platform} has an arm or a gimbal: use +arm or +gimbal")
        return None
    base = STM32_TRAITS if platform == Platform.STM32 else CarTraits()
    traits = base
    given: set[str] = set()
    for option in options:
        traits = _with_option(traits, platform, option)
        word, has_value, _ = option.partition("=")
        if has_value and word in given and word != SILENT:
            raise BadOption(f"option '+{word}' is given twice: give it once")
        given.add(word)
    if traits.spread_s >= traits.interval_s:
        words = f"+spread={traits.spread_s:g} is not allowed: use less than the interval, {traits.interval_s:g} s"
        raise BadOption(f"option {words}")
    return None if traits == base else traits


def allowed_options(platform: str) -> str:
    """Return the options of a platform, as text for an error message."""
    if platform in UGV_BUILDS:
        return ", ".join(f"+{word}" for word in UGV_OPTIONS)
    own = [f"+{word}={_PLACEHOLDERS[word]}" if word in _PLACEHOLDERS else f"+{word}" for word in SIMULATED[platform]]
    return "none" if platform == "course" else ", ".join((OPTION_WORDS, *own))


def _with_option(traits: CarTraits, platform: str, option: str) -> CarTraits:
    word, equals, value = option.partition("=")
    shared = word in (*OPTIONS, *VARIANTS, HEAD) and platform != "course"
    if not (shared or word in SIMULATED[platform]) or bool(equals) != (word in _PLACEHOLDERS or word == HEAD):
        allowed = allowed_options(platform)
        raise BadOption(f"option '+{option}' of {platform} is not allowed: use {allowed}")
    if word in OPTIONS:
        return traits
    if word in FLAGS:
        return replace(traits, **FLAGS[word])
    if word == HEAD:
        try:
            check_head(value)
        except ValueError as error:
            raise BadOption(f"option '+{option}': {error}") from None
        return replace(traits, head=value)
    if word == SILENT:
        if value not in set(Mode):
            raise BadOption(f"option '+{option}' is not allowed: use one of {', '.join(Mode)}")
        return replace(traits, silent_modes=traits.silent_modes | {Mode(value)})
    field, least, most, what = NUMBERS[word]
    try:
        number = int(value) if isinstance(least, int) else float(value)
    except ValueError:
        number = math.nan
    if not least <= number <= most:
        raise BadOption(f"option '+{option}' is not allowed: use {what} from {least:g} to {most:g}")
    changes: dict[str, Any] = {field: number}
    return replace(traits, **changes)
