"""The abilities of a car, with the reasons of those that it lacks, from the states of its gateway. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from gateway.protocol.frames import ArmSet, ColorLed, Frame, General, ModeOpen, Ptz
from gateway.protocol.platforms import Profile, parse_platform
from schemas.words import Light, Mode, Motion, ServoAction

_EXAMPLES: Final[dict[str, Frame]] = {
    "mode": ModeOpen(Mode.TRACKING),
    "led": ColorLed(0, 0, 0),
    "servo_deg": Ptz(90),
    "arm": ArmSet((90,) * 6),
    "servo_vertical": General(Motion.STOP, servo=ServoAction.VERTICAL_UP),
    "servo_horizontal": General(Motion.STOP, servo=ServoAction.HORIZONTAL_LEFT),
}
"""A frame for each capability that some cars lack."""
_CAPABILITIES: Final = (*_EXAMPLES, "drive", "whistle", "speed", "servo", "fan", "light")


@dataclass(frozen=True, slots=True)
class Abilities:
    """The controls of one car's page."""

    modes: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()
    can: tuple[str, ...] = ()
    cannot: tuple[tuple[str, str], ...] = ()
    """Missing capabilities, each with the reason."""

    def as_dict(self) -> dict[str, Any]:
        """Return them as JSON values."""
        return {"modes": self.modes, "lights": self.lights, "can": self.can, "cannot": dict(self.cannot)}


UNKNOWN_ABILITIES: Final = Abilities(cannot=(("drive", "No gateway has said yet what this car can do."),))


@cache
def abilities_of(platform: str, capabilities: tuple[str, ...]) -> Abilities:
    """Return the abilities of a platform whose gateway lists these capabilities."""
    try:
        profile = parse_platform(platform)
    except ValueError:
        return UNKNOWN_ABILITIES
    can = tuple(name for name in _CAPABILITIES if name in capabilities)
    cannot = tuple((name, _reason(profile, name)) for name in _CAPABILITIES if name not in capabilities)
    modes = _in_order(Mode, profile.modes if "mode" in can else ())
    lights = _in_order(Light, profile.lights if "light" in can else ())
    return Abilities(modes, lights, can, cannot)


def _reason(profile: Profile, name: str) -> str:
    refusal = profile.refusal(_EXAMPLES[name]) if name in _EXAMPLES else None
    words = refusal or f"the fleet file leaves out {name}"
    return f"{words[0].upper()}{words[1:]}."


def _in_order(words: Iterable[str], chosen: Iterable[str]) -> tuple[str, ...]:
    known = set(chosen)
    return tuple(str(word) for word in words if word in known)
