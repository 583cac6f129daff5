"""Turns a decoder's event into its verdict and the measured fields per topic. Pure.

The level of the battery is an estimate of the gateway and is not set here.
"""

from gateway.protocol.enums import Mode
from gateway.protocol.events import ArmReading, Echo, Event, ImuReading, Rejected, Sensors
from gateway.protocol.platforms import Profile

Value = bool | int | float | tuple[float, ...]
Fields = dict[str, Value]

_LINE = ("left_outer", "left_inner", "right_inner", "right_outer")
_IMU = ("gyro_x_raw", "gyro_y_raw", "gyro_z_raw", "accel_x_raw", "accel_y_raw", "accel_z_raw")


def verdict_of(event: Event) -> str:
    """Return `sensors`, `arm`, `imu`, `echo`, or the cause of the rejection."""
    match event:
        case Sensors():
            return "sensors"
        case ArmReading():
            return "arm"
        case ImuReading():
            return "imu"
        case Echo():
            return "echo"
        case Rejected(cause=cause):
            return str(cause)


def measured(event: Event, profile: Profile, confirmed: Mode | None) -> dict[str, Fields]:
    """Return the measured fields by topic, in the order of publication, in the units of the messages.

    `confirmed`: the confirmed mode of the car, or None. Fields that were not measured are omitted.
    """
    match event:
        case Sensors():
            return _sensors(event, profile, confirmed)
        case ArmReading(joint_deg=joints):
            degrees = tuple(joint for joint in joints if joint is not None)
            return {"sensor/arm": {"joint_deg": degrees}} if len(degrees) == len(joints) else {}
        case ImuReading():
            return {"sensor/imu": dict(zip(_IMU, (*event.gyro, *event.accel), strict=True))}
        case Echo() | Rejected():
            return {}


def _sensors(event: Sensors, profile: Profile, confirmed: Mode | None) -> dict[str, Fields]:
    names = profile.measured(event, confirmed)
    topics: dict[str, Fields] = {}
    if "range" in names and event.range_cm is not None:
        # A range of 0 is no echo, not a distance (docs/reference/protocol.md#ranges).
        topics["sensor/range"] = (
            {"no_echo": False, "range_m": round(event.range_cm / 100, 4)} if event.range_cm else {"no_echo": True}
        )
    if "battery" in names and event.voltage_v is not None:
        topics["sensor/battery"] = {"voltage_v": event.voltage_v}
    if "grayscale" in names and event.grayscale is not None:
        topics["sensor/grayscale"] = {"raw": event.grayscale}
    if "line" in names and event.line is not None:
        topics["sensor/line"] = dict(zip(_LINE, event.line, strict=True))
    if "obstacle" in names and (obstacle := profile.obstacle(event, confirmed)) is not None:
        topics["sensor/obstacle"] = {"left": obstacle[0], "right": obstacle[1]}
    if "light" in names and event.light is not None:
        topics["sensor/light"] = {"left": event.light[0], "right": event.light[1]}
    return topics
