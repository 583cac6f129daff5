"""The events of the frame splitter, one class each.

`Sensors`, the event of a sensors frame, is in `sensors`. `Echo`, `Rejected` and `TextLine`, which every family of cars
has, are in `gateway.control.driver`. Everything that depends on the platform is in `platforms`.
"""

from msgspec import Struct

from gateway.control.driver import Echo, Rejected, TextLine
from gateway.drivers.yahboom.protocol.sensors import RejectedField, Sensors


class ArmReading(Struct, frozen=True):
    """Six joints, 0..180 degrees. None where the joint was rejected. `at` is the time of the last byte."""

    raw: bytes
    at: float
    joint_deg: tuple[float | None, ...]
    rejects: tuple[RejectedField, ...] = ()


class ImuReading(Struct, frozen=True):
    """Gyro and acceleration x, y, z in raw counts (docs/reference/protocol.md gives no unit).

    `at` is the time of the last byte.
    """

    raw: bytes
    at: float
    gyro: tuple[float, float, float]
    accel: tuple[float, float, float]


Event = Sensors | ArmReading | ImuReading | Echo | Rejected | TextLine
