"""Colors of states and LEDs: one meaning has one color in every view. Pure."""

from collections.abc import Iterable, Mapping
from typing import Final

from schemas.colors import Rgb
from schemas.commands import COMMANDS

OFF: Final[Rgb] = (70, 74, 82)
"""Color of a lamp or LED that is off."""


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
