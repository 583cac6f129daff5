"""Colors of states and LEDs, so that the same meaning has the same color in every view. Pure."""

from collections.abc import Iterable, Mapping
from typing import Final

from schemas.colors import Rgb
from schemas.commands import COMMANDS
from schemas.words import (
    MODE_COLORS,
    UNKNOWN,
    BatteryLevel,
    LinkState,
    Motion,
    Motors,
    Phase,
    RecorderState,
    RunState,
    Verdict,
)

OFF: Final[Rgb] = (70, 74, 82)
"""Color of a lamp or LED that is off."""


STATE_COLORS: Final[Mapping[str, int]] = {
    "true": 0x4FB477FF, "false": 0x30343BFF,
    LinkState.ONLINE: 0x4FB477FF, LinkState.QUIET: 0x5C7FA3FF, LinkState.STALE: 0xE0A030FF, LinkState.LOST: 0xD9534FFF,
    Verdict.CONFIRMED: 0x4FB477FF, Verdict.ASSUMED: 0x8A8F98FF, Verdict.CONTRADICTED: 0xD9534FFF, UNKNOWN: 0x555A63FF,
    **{mode: color << 8 | 0xFF for mode, color in MODE_COLORS.items()},
    Motion.STOP: 0x30343BFF, Motion.FORWARD: 0x4FB477FF, Motion.BACK: 0xD08A3CFF, Motion.LEFT: 0x5C7FA3FF,
    Motion.RIGHT: 0x8E6BBFFF, Motion.SPIN_LEFT: 0x3C9D9BFF, Motion.SPIN_RIGHT: 0xC0689FFF,
    Motors.OFF: 0x30343BFF, Motors.ON: 0x4FB477FF,
    BatteryLevel.OK: 0x4FB477FF, BatteryLevel.LOW: 0xE0A030FF, BatteryLevel.CRITICAL: 0xD9534FFF,
    RecorderState.RECORDING: 0x4FB477FF,
    RunState.RUNNING: 0x4FB477FF, RunState.STARTING: 0x5C7FA3FF, RunState.ENDING: 0x8A8F98FF,
    RecorderState.CLOSED: 0x8A8F98FF, RunState.ENDED: 0x8A8F98FF,
    RecorderState.FULL: 0xD9534FFF, RecorderState.FAILED: 0xD9534FFF,
}  # fmt: skip
"""Colors of states, 0xRRGGBBAA. For any other state the viewer picks a color."""

_PHASE_COLORS: Final[Mapping[str, int]] = {
    Phase.ASKED: 0x8A8F98FF, Phase.QUEUED: 0xC9B037FF, Phase.SENT: 0x5C7FA3FF, Phase.EFFECT_SEEN: 0x3C9D9BFF,
    Phase.COMPLETE: 0x4FB477FF, Phase.SUPERSEDED: 0x8E6BBFFF, Phase.EXPIRED: 0xE0A030FF, Phase.FAILED: 0xD9534FFF,
    Phase.REJECTED: 0xD9534FFF,
}  # fmt: skip

MARK_COLORS: Final[Mapping[str, int]] = {
    f"{verb} {phase}": tint for verb in COMMANDS for phase, tint in _PHASE_COLORS.items()
}
"""Colors of the marks of commands, by phase."""


def rgb(led: str) -> Rgb:
    """Return the color of an LED in `sim/truth`, which is `#rrggbb`. Any other text means that the LED is off."""
    try:
        red, green, blue = bytes.fromhex(led.removeprefix("#"))
    except ValueError:
        return OFF
    return red, green, blue


def leds(seen: Iterable[str]) -> Mapping[str, int]:
    """Return the colors for tracks of LEDs: each state has the color of the LED."""
    return {led: int.from_bytes((*rgb(led), 255), "big") for led in sorted(seen)}
