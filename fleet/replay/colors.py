"""Colors of cars, states and LEDs: one meaning has one color in every view. Pure."""

from collections.abc import Iterable, Mapping
from typing import Final

from schemas.colors import Rgb
from schemas.commands import COMMANDS

OFF: Final[Rgb] = (70, 74, 82)
"""Color of a lamp or LED that is off."""

_CAR_COLORS: Final[Mapping[str, Rgb]] = {
    "red": (235, 80, 80), "green": (90, 200, 110), "blue": (90, 150, 250), "yellow": (235, 205, 70),
    "orange": (245, 150, 60), "white": (230, 230, 230), "black": (130, 130, 130), "pink": (245, 130, 190),
}  # fmt: skip
_OTHER_COLORS: Final[tuple[Rgb, ...]] = (
    (80, 200, 200), (190, 130, 240), (245, 150, 60), (160, 200, 80), (230, 120, 160), (120, 160, 200),
)  # fmt: skip

STATE_COLORS: Final[Mapping[str, int]] = {
    "true": 0x4FB477FF, "false": 0x30343BFF,
    "online": 0x4FB477FF, "quiet": 0x5C7FA3FF, "stale": 0xE0A030FF, "lost": 0xD9534FFF,
    "confirmed": 0x4FB477FF, "assumed": 0x8A8F98FF, "contradicted": 0xD9534FFF, "unknown": 0x555A63FF,
    "manual": 0x5C7FA3FF, "tracking": 0x8E6BBFFF, "obstacle_avoidance": 0xD08A3CFF, "light_seeking": 0xC9B037FF,
    "following": 0x3C9D9BFF, "color_led": 0xC0689FFF, "remote_control": 0xA0522DFF,
    "stop": 0x30343BFF, "forward": 0x4FB477FF, "back": 0xD08A3CFF, "left": 0x5C7FA3FF, "right": 0x8E6BBFFF,
    "spin_left": 0x3C9D9BFF, "spin_right": 0xC0689FFF,
    "off": 0x30343BFF, "on": 0x4FB477FF,
    "ok": 0x4FB477FF, "low": 0xE0A030FF, "critical": 0xD9534FFF,
    "recording": 0x4FB477FF, "running": 0x4FB477FF, "starting": 0x5C7FA3FF, "ending": 0x8A8F98FF,
    "closed": 0x8A8F98FF, "ended": 0x8A8F98FF, "full": 0xD9534FFF, "failed": 0xD9534FFF,
}  # fmt: skip
"""Colors of states, 0xRRGGBBAA. The viewer picks the color of other states."""

_PHASE_COLORS: Final[Mapping[str, int]] = {
    "asked": 0x8A8F98FF, "queued": 0xC9B037FF, "sent": 0x5C7FA3FF, "effect_seen": 0x3C9D9BFF, "complete": 0x4FB477FF,
    "superseded": 0x8E6BBFFF, "expired": 0xE0A030FF, "failed": 0xD9534FFF, "rejected": 0xD9534FFF,
}  # fmt: skip

MARK_COLORS: Final[Mapping[str, int]] = {
    f"{verb} {phase}": tint for verb in COMMANDS for phase, tint in _PHASE_COLORS.items()
}
"""Colors of the marks of commands, by phase."""


def color(car: str, index: int) -> Rgb:
    """Return the color of a car: the one it is named after, else one by its index."""
    return _CAR_COLORS.get(car, _OTHER_COLORS[index % len(_OTHER_COLORS)])


def rgb(led: str) -> Rgb:
    """Return the color of an LED in `sim/truth`: `#rrggbb`; anything else is off."""
    try:
        red, green, blue = bytes.fromhex(led.removeprefix("#"))
    except ValueError:
        return OFF
    return red, green, blue


def leds(seen: Iterable[str]) -> Mapping[str, int]:
    """Return the colors for tracks of LEDs: each state has the color of the LED."""
    return {led: int.from_bytes((*rgb(led), 255), "big") for led in sorted(seen)}
