"""Turns a decoder's event into its verdict and the measured fields per topic. Pure.

The level of the battery is not set here, because the gateway estimates it.
"""

from gateway.control.driver import Echo, Rejected, TextLine
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.sensors import SENSOR_FIELDS, Fields, Sensors
from gateway.drivers.yahboom.protocol.wire_events import ArmReading, Event, ImuReading
from schemas.words import FrameVerdict, Mode

_PUBLISHED = tuple((each.measurement, each.attribute, each.topic, each.to_message) for each in SENSOR_FIELDS)
_IMU = ("gyro_x_raw", "gyro_y_raw", "gyro_z_raw", "accel_x_raw", "accel_y_raw", "accel_z_raw")


def verdict_of(event: Event) -> str:
    """Return `sensors`, `arm`, `imu`, `echo`, `text`, or the cause of the rejection."""
    match event:
        case Sensors():
            return FrameVerdict.SENSORS
        case ArmReading():
            return FrameVerdict.ARM
        case ImuReading():
            return FrameVerdict.IMU
        case Echo():
            return FrameVerdict.ECHO
        case TextLine():
            return FrameVerdict.TEXT
        case Rejected(cause=cause):
            return str(cause)


def measured(
    event: Event, profile: Profile, confirmed: Mode | None, *, may_be_stm32: bool = False
) -> dict[str, Fields]:
    """Return the measured fields by topic, in the order of publication, in the units of the messages.

    `confirmed` is the confirmed mode of the car, or None. Fields that were not measured are omitted. With
    `may_be_stm32`, the car may also run an stm32 program, some of whose fields are constants.
    """
    match event:
        case Sensors():
            return _sensors(event, profile, confirmed, may_be_stm32=may_be_stm32)
        case ArmReading(joint_deg=joints):
            degrees = tuple(joint for joint in joints if joint is not None)
            return {"sensor/arm": {"joint_deg": degrees}} if len(degrees) == len(joints) else {}
        case ImuReading():
            return {"sensor/imu": dict(zip(_IMU, (*event.gyro, *event.accel), strict=True))}
        case Echo() | Rejected() | TextLine():
            return {}


def _sensors(event: Sensors, profile: Profile, confirmed: Mode | None, *, may_be_stm32: bool) -> dict[str, Fields]:
    names = profile.measured(event, confirmed, may_be_stm32=may_be_stm32)
    topics: dict[str, Fields] = {}
    for name, attribute, topic, published in _PUBLISHED:
        if name in names:
            # The meaning of the obstacle bits depends on the platform and the mode.
            value = profile.obstacle(event, confirmed) if name == "obstacle" else getattr(event, attribute)
            topics[topic] = published(value)
    return topics
