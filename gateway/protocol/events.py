"""What a decoder hands out: one value per event, and what a sensors frame's own text says about the car's mode.

No parsing lives here (see `decode`), and nothing that depends on the platform (see `profile`).
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from gateway.protocol.enums import Mode


class Cause(StrEnum):
    """Why bytes are no reading (docs/reference/protocol.md#bad-input)."""

    NO_START = "no_start"
    OVERLONG = "overlong"
    UNKNOWN_WORD = "unknown_word"
    MISSING_WORD = "missing_word"
    BAD_NUMBER = "bad_number"
    OUT_OF_RANGE = "out_of_range"
    TRUNCATED = "truncated"


@dataclass(frozen=True, slots=True)
class Reject:
    """One field of a good frame whose value is out of its range."""

    word: str
    text: str
    cause: Cause = Cause.OUT_OF_RANGE


class Sensors(NamedTuple):
    """The sensors frame, each field as on the wire; None where the field was rejected.

    `at` is the time of its last byte. `range_cm` 0 means no echo, not a distance. `line` is left-outer, left-inner,
    right-inner, right-outer. `obstacle` is not inverted here, whatever the mode (see `Profile.obstacle`).
    Whether a field is measured or filler is not said here either (see `Profile.measured`).
    A named tuple, because a frozen dataclass of this size costs as much as decoding the frame.
    """

    raw: bytes
    at: float
    range_cm: float | None
    voltage_v: float | None
    grayscale: int | None
    line: tuple[bool, bool, bool, bool] | None
    obstacle: tuple[bool, bool] | None
    light: tuple[bool, bool] | None
    rejects: tuple[Reject, ...] = ()
    terminated: bool = True  # by `#`
    by_silence: bool = False  # not terminated, and nothing followed (for 50 ms, or at all): a `#` may be late

    @property
    def candidates(self) -> tuple[Mode, ...]:
        """The modes whose frame has this text, by the constant filler in it; never empty, in order of digit."""
        return _candidates(self.raw, terminated=self.terminated, by_silence=self.by_silence)

    @property
    def signature(self) -> Mode | None:
        """The one mode whose frame has this text; None if there is more than one candidate."""
        candidates = self.candidates
        return candidates[0] if len(candidates) == 1 else None


@dataclass(frozen=True, slots=True)
class ArmReading:
    """Six joints, 0..180 degrees; None where the joint was rejected. `at` is the time of the last byte."""

    raw: bytes
    at: float
    joint_deg: tuple[float | None, ...]
    rejects: tuple[Reject, ...] = ()


@dataclass(frozen=True, slots=True)
class ImuReading:
    """Gyro and acceleration x, y, z in raw counts (the table gives no unit). `at` is the time of the last byte."""

    raw: bytes
    at: float
    gyro: tuple[float, float, float]
    accel: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Echo:
    """Bytes equal to a frame that we sent in the last 2 s. `at` is the time of the last byte."""

    raw: bytes
    at: float


@dataclass(frozen=True, slots=True)
class Rejected:
    """Bytes that are no reading, why, and in words for a person. `at` is the time of the last byte."""

    raw: bytes
    at: float
    cause: Cause
    detail: str = ""


Event = Sensors | ArmReading | ImuReading | Echo | Rejected

# Spelling counts: mode 0 has decimals on Arduino, PV8.4 on Raspberry Pi (docs/reference/protocol.md#placeholders).
_TRACKING = b"$4WD,CSB0,PV8,GS0,LF"
_LIGHT_OR_FOLLOWING = b"$4WD,CSB120,PV8.3,GS000,LF0000,HW"


def _candidates(raw: bytes, *, terminated: bool, by_silence: bool) -> tuple[Mode, ...]:
    text = raw[:-1] if terminated else raw
    if text.startswith(_TRACKING):
        return (Mode.TRACKING,) if text.endswith(b",HW00,GM00") else (Mode.MANUAL,)
    if not text.startswith(_LIGHT_OR_FOLLOWING):
        return (Mode.MANUAL,)
    no_obstacle, no_light = text[-7:-5] == b"00", text[-2:] == b"00"
    if not no_light:
        return (Mode.LIGHT_SEEKING,) if no_obstacle else (Mode.MANUAL,)
    if terminated:
        # HWab with a `#` fits neither row: following with a `#` got from somewhere, or a curious mode 0
        return (Mode.LIGHT_SEEKING,) if no_obstacle else (Mode.MANUAL, Mode.FOLLOWING)
    # without `#` before a `$` it is following; before a silence the `#` of light seeking may still be on its way
    return (Mode.LIGHT_SEEKING, Mode.FOLLOWING) if no_obstacle and by_silence else (Mode.FOLLOWING,)
