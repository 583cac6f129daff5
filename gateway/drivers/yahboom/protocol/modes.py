"""The modes of the car's program, one row each: digit, times, report rate, measurements and filler.

The filler of a mode is the fixed text in the fields that the car does not measure in this mode.
"""

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

from msgspec import Struct

from gateway.drivers.yahboom.protocol.sensors import SENSOR_FIELDS, Sensors, sensors_pattern
from schemas.words import Mode

EVERY_MEASUREMENT: Final = frozenset(field.measurement for field in SENSOR_FIELDS)


class ModeRow(Struct, frozen=True):
    """The facts of docs/reference/protocol.md#modes about one mode.

    `digit` is the x of `MODE<x><y>`. `open_s` is the time for which opening the mode blocks the car. `turn_s` is the
    longest block of one turn of the mode's own loop. `first_reading_s` is the longest time from the end of the opening
    to the first reading, while the motors already run. `rate_hz` is the maximum number of sensors frames per second.
    `measures` lists the measurements in a frame of this mode, even if only other programs than the vendor's print such
    a frame.
    """

    digit: int
    open_s: float
    turn_s: float
    rate_hz: float = 0.0
    measures: frozenset[str] = frozenset()
    signature: re.Pattern[bytes] | None = None
    """Matches a frame whose other fields are this mode's filler. None if the mode has no filler of its own."""
    has_end: bool = True
    """True if the frame ends with `#`."""
    first_reading_s: float = 0.0

    @property
    def is_silent(self) -> bool:
        """True if the vendor's program sends no readings in this mode."""
        return self.rate_hz == 0.0


def _open_s(digit: int) -> float:
    # An opening takes 2.1 s and 0.2 s for each digit up to its own (docs/reference/protocol.md#blocking-times).
    return round(2.1 + 0.2 * (digit + 1), 3)


def _signature(filler: Mapping[str, bytes]) -> re.Pattern[bytes]:
    return re.compile(sensors_pattern(filler) + b"#?")


# Measured: 1.69 s in tracking, 1.6 s in light seeking. Assumed in following (docs/reference/protocol.md#rates).
FIRST_READING_S: Final = 1.7

# The spelling of the filler tells the modes apart (docs/reference/protocol.md#placeholders).
_TRACKING: Final = {"range": b"0", "battery": b"8", "grayscale": b"0", "obstacle": b"00", "light": b"00"}
_SEEKING: Final = {"range": b"120", "battery": b"8.3", "grayscale": b"000", "line": b"0000", "obstacle": b"00"}
_FOLLOWING: Final = {"range": b"120", "battery": b"8.3", "grayscale": b"000", "line": b"0000", "light": b"00"}
# The vendor's avoidance is silent, but some programs print a range with filler in it
# (docs/reference/protocol.md#programs-that-people-have). With CSB120 this text is that of light seeking.
_AVOIDING: Final = re.compile(rb"\$[0-9A-Za-z]+,CSB(?!120,)[0-9]+,PV8\.3,GS000,LF0000,HW00,GM00#?")

# turn_s, rate_hz: docs/reference/protocol.md#blocking-times and docs/reference/protocol.md#rates
MODES: Final[Mapping[Mode, ModeRow]] = {
    # mode 0 is never opened; its report takes 1.0 s if the ranging gets no echo
    Mode.MANUAL: ModeRow(0, 0.0, 1.0, rate_hz=1.0, measures=EVERY_MEASUREMENT),
    # docs/reference/protocol.md has no turn time for this mode: assumed as in the modes that only read pins
    Mode.REMOTE_CONTROL: ModeRow(1, _open_s(1), 0.1),
    Mode.TRACKING: ModeRow(
        2, _open_s(2), 0.12, 27.0, frozenset({"line"}), _signature(_TRACKING), first_reading_s=FIRST_READING_S
    ),
    # near an obstacle, a turn takes 4.3 s; without any echo it never ends, and the motors are braked
    Mode.OBSTACLE_AVOIDANCE: ModeRow(3, _open_s(3), 4.3, measures=frozenset({"range"}), signature=_AVOIDING),
    Mode.COLOR_LED: ModeRow(4, _open_s(4), 0.75),
    Mode.LIGHT_SEEKING: ModeRow(
        5, _open_s(5), 0.11, 23.0, frozenset({"light"}), _signature(_SEEKING), first_reading_s=FIRST_READING_S
    ),
    Mode.FOLLOWING: ModeRow(
        6,
        _open_s(6),
        0.1,
        24.0,
        frozenset({"obstacle"}),
        _signature(_FOLLOWING),
        has_end=False,
        first_reading_s=FIRST_READING_S,
    ),
}

SILENT_MODES: Final = frozenset(mode for mode, row in MODES.items() if row.is_silent)
_SIGNED: Final = tuple((mode, row, row.signature) for mode, row in MODES.items() if row.signature is not None)


def candidate_modes(frame: Sensors) -> tuple[Mode, ...]:
    """Return the modes whose sensors frame has this text, by its filler. At least one, sorted by digit."""
    return _candidates(frame.raw, frame.terminated, frame.by_silence)


def only_candidate(frame: Sensors) -> Mode | None:
    """Return the only mode whose sensors frame has this text. None if there are several."""
    candidates = candidate_modes(frame)
    return candidates[0] if len(candidates) == 1 else None


# The control code asks this several times for one event, so cache the result.
@lru_cache(maxsize=8)
def _candidates(raw: bytes, terminated: bool, by_silence: bool) -> tuple[Mode, ...]:  # noqa: FBT001 - two facts of a frame
    found = [(mode, row) for mode, row, signature in _SIGNED if signature.fullmatch(raw)]
    if not found:
        return (Mode.MANUAL,)
    # The end of the frame distinguishes light seeking from following. But if the frame was ended by a silence, its `#`
    # may still be on its way.
    if len(found) > 1 and not by_silence:
        found = [(mode, row) for mode, row in found if row.has_end is terminated]
    modes = tuple(mode for mode, _ in found)
    # If there is a `#` although this mode sends none, either the `#` is foreign, or the frame is one of mode 0
    # that happens to have the same text.
    return (Mode.MANUAL, *modes) if terminated and not any(row.has_end for _, row in found) else modes
