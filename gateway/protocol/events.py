"""The events of a decoder, one value each.

`Sensors`, the event of a sensors frame, is in `sensors`. Everything that depends on the platform is in `platforms`.
"""

from dataclasses import dataclass

from gateway.protocol.sensors import Reject, Sensors
from schemas.words import Cause


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


@dataclass(frozen=True, slots=True)
class TextLine:
    """A whole line of text between frames with its line end, such as a debug print. It is no damage.

    `at` is the time of the last byte of the junk that it came with.
    """

    raw: bytes
    at: float


Event = Sensors | ArmReading | ImuReading | Echo | Rejected | TextLine
