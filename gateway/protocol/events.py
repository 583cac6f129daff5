"""The events of a decoder, one value each.

The parsing is in `parser`; everything that depends on the platform is in `platforms`.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from gateway.protocol.enums import Mode
from gateway.protocol.modes import matching_modes


class Cause(StrEnum):
    """Why bytes are not a reading (docs/reference/protocol.md#bad-input)."""

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
    right-inner, right-outer. `obstacle` is as on the wire; `Profile.obstacle` undoes the inversion of following.
    `Profile.measured` tells measurements from filler.
    """

    # A named tuple: creating a frozen dataclass of this size costs as much as decoding the frame.
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
    by_silence: bool = False  # not terminated, and nothing followed for 50 ms or to the end: a `#` may be late

    @property
    def candidates(self) -> tuple[Mode, ...]:
        """The modes whose frame has this text, by its filler; never empty, in order of digit."""
        return matching_modes(self.raw, self.terminated, self.by_silence)

    @property
    def signature(self) -> Mode | None:
        """The only candidate mode. None if there are several."""
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
    """Bytes that are not a reading, with the cause. `detail` is for a person; `at` is the time of the last byte."""

    raw: bytes
    at: float
    cause: Cause
    detail: str = ""


Event = Sensors | ArmReading | ImuReading | Echo | Rejected
