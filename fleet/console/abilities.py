"""The abilities of a car, and the reason for each that it lacks, computed from the states of its gateway. Pure."""

from collections.abc import Iterable
from functools import cache
from typing import Any, Final

from msgspec import Struct

from gateway import drivers
from schemas.car_profile import CarProfile
from schemas.words import CAPABILITIES, Light, Mode


class Abilities(Struct, frozen=True):
    """The controls of one car's page."""

    modes: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()
    can: tuple[str, ...] = ()
    cannot: tuple[tuple[str, str], ...] = ()
    """Missing capabilities, each with the reason."""

    def as_dict(self) -> dict[str, Any]:
        """Return the abilities as JSON values."""
        return {"modes": self.modes, "lights": self.lights, "can": self.can, "cannot": dict(self.cannot)}


UNKNOWN_ABILITIES: Final = Abilities(cannot=(("drive", "No gateway has said yet what this car can do."),))


@cache
def abilities_of(platform: str, capabilities: tuple[str, ...]) -> Abilities:
    """Return the abilities of a platform whose gateway lists these capabilities."""
    try:
        profile = drivers.profile_of(platform)
    except ValueError:
        return UNKNOWN_ABILITIES
    can = tuple(name for name in CAPABILITIES if name in capabilities)
    cannot = tuple((name, _reason(profile, name)) for name in CAPABILITIES if name not in capabilities)
    modes = _in_order(Mode, profile.modes if "mode" in can else ())
    lights = _in_order(Light, profile.lights if "light" in can else ())
    return Abilities(modes, lights, can, cannot)


def _reason(profile: CarProfile, name: str) -> str:
    words = profile.why_lacking(name) or f"the fleet file leaves out {name}"
    return f"{words[0].upper()}{words[1:]}."


def _in_order(words: Iterable[str], chosen: Iterable[str]) -> tuple[str, ...]:
    known = set(chosen)
    return tuple(str(word) for word in words if word in known)
