"""Writes a session as a ROS 2 bag with standard messages only, which every ROS 2 tool can read. Needs rosbags.

A topic is `/<car>/<topic>`, as in `/red/range`. If ROS has a standard message for a reading, that message is used, with
ROS's units and its value for "not measured". Everything else, also a reading with a number that this message cannot
hold, becomes a DiagnosticArray with all fields as text, so no message of the fleet is lost. Stamps are by the gateway's
clock, the times of the bag by the recorder's clock. Frames are `<car>/<topic>`, as in `red/range`, except for poses: a
measured one has the frame that it names, a true one has `world`. There are no transforms, because nobody has measured
where the sensors sit on the cars.
"""

import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

from google.protobuf.message import Message
from msgspec import Struct, field

from fleet.recording.foreign_fields import text_of
from fleet.recording.left_out import LeftOut
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.message_decoder import MessageDecoder, why_not_decoded
from fleet.recording.tools.car_timeline import message_time_ns
from fleet.recording.tools.table_export import numbered
from fleet.recording.tools.table_formats import FormatMissing
from fleet.recording.tools.tables import plain
from schemas import keys

try:
    import numpy as np
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError:
    raise FormatMissing("rosbags") from None

BAG_VERSION: Final = 9
"""Version of the metadata: that of ROS 2 Jazzy, which reads MCAP without a plugin."""
RANGE_MIN_M: Final = 0.01
RANGE_MAX_M: Final = 12.0
"""Range of the ultrasonic sensor by the message `fleet.v1.Range`."""
NOT_MEASURED: Final = -1.0
"""First element of a covariance in sensor_msgs/Imu, if the message does not have the value."""
INT32_MAX: Final = 2**31 - 1
_NAN: Final = float("nan")
_LOG_LEVELS: Final = {1: 10, 2: 20, 3: 30, 4: 40, 5: 50}
"""Level of foxglove.Log: that of rcl_interfaces/Log."""
_COMMON: Final = frozenset({"stamp", "timestamp", "car"})
"""Fields that are in the header or in the name of the topic, and so are left out."""

_STORE: Final = get_typestore(Stores.ROS2_JAZZY)


def _ros(name: str, /, **fields: Any) -> Any:
    """Return a message of ROS."""
    return _STORE.types[name](**fields)


def _stamp(at_ns: int) -> Any:
    seconds, nanos = divmod(max(at_ns, 0), 1_000_000_000)
    return _ros("builtin_interfaces/msg/Time", sec=min(seconds, INT32_MAX), nanosec=nanos)


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, of: str = "Vector3") -> Any:
    return _ros(f"geometry_msgs/msg/{of}", x=x, y=y, z=z)


def _quaternion(roll: float, pitch: float, yaw: float) -> Any:
    """Return the rotation of fixed axes x, y, z (REP-103), rad."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(each / 2), math.cos(each / 2)) for each in (roll, pitch, yaw))
    return _ros(
        "geometry_msgs/msg/Quaternion",
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


def _range(message: Any, header: Any) -> Any:
    """Return the distance, +inf if there was no echo (REP-117), or NaN if nothing was measured."""
    measured = message.range_m if message.HasField("range_m") else _NAN
    return _ros(
        "sensor_msgs/msg/Range",
        header=header,
        radiation_type=0,
        field_of_view=0.0,
        min_range=RANGE_MIN_M,
        max_range=RANGE_MAX_M,
        range=math.inf if message.no_echo else measured,
        variance=0.0,  # unknown
    )


def _battery(message: Any, header: Any) -> Any:
    """Return the voltage, and the charge if it is known. All other values are NaN, which means not measured."""
    none: Any = _STORE.types["sensor_msgs/msg/BatteryState"]
    return none(
        header=header,
        voltage=message.voltage_v,
        temperature=_NAN,
        current=_NAN,
        charge=_NAN,
        capacity=_NAN,
        design_capacity=_NAN,
        percentage=message.charge if message.HasField("charge") else _NAN,
        power_supply_status=none.POWER_SUPPLY_STATUS_UNKNOWN,
        power_supply_health=none.POWER_SUPPLY_HEALTH_UNKNOWN,
        power_supply_technology=none.POWER_SUPPLY_TECHNOLOGY_LION,
        present=True,
        cell_voltage=_array(()),
        cell_temperature=_array(()),
        location="",
        serial_number="",
    )


def _array(values: Iterable[float], kind: str = "float32") -> Any:
    return np.array(tuple(values), dtype=kind)


def _attitude(message: Any, header: Any) -> Any:
    none = _array((NOT_MEASURED, *[0.0] * 8), "float64")
    return _ros(
        "sensor_msgs/msg/Imu",
        header=header,
        orientation=_quaternion(message.roll_rad, message.pitch_rad, message.yaw_rad),
        orientation_covariance=_array([0.0] * 9, "float64"),  # unknown
        angular_velocity=_vector(),
        angular_velocity_covariance=none,
        linear_acceleration=_vector(),
        linear_acceleration_covariance=none,
    )


def _joints(header: Any, names: Iterable[str], position: Iterable[float] = (), velocity: Iterable[float] = ()) -> Any:
    return _ros(
        "sensor_msgs/msg/JointState",
        header=header,
        name=list(names),
        position=_array(position, "float64"),
        velocity=_array(velocity, "float64"),
        effort=_array((), "float64"),
    )


_SIDES: Final = ("left_wheels", "right_wheels")


def _wheels(message: Any, header: Any) -> Any:
    """Return the speed of each side in m/s and not in rad/s, because the radius of the wheels is not known."""
    return _joints(header, _SIDES, velocity=(message.left_m_s, message.right_m_s))


def _odometer(message: Any, header: Any) -> Any:
    """Return the distance that each side has covered, m."""
    return _joints(header, _SIDES, position=(message.left_m, message.right_m))


def _arm(message: Any, header: Any) -> Any:
    names = [f"joint_{number}" for number in range(1, len(message.joint_deg) + 1)]
    return _joints(header, names, position=map(math.radians, message.joint_deg))


def _pose(message: Any, header: Any) -> Any:
    """Return a measured pose on the floor. A value whose deviation is not known has a covariance of 0."""
    header.frame_id = message.frame or header.frame_id
    covariance = np.zeros(36)
    covariance[[0, 7]], covariance[35] = message.xy_std_m**2, message.heading_std_rad**2
    pose = _ros(
        "geometry_msgs/msg/Pose",
        position=_vector(message.x_m, message.y_m, of="Point"),
        orientation=_quaternion(0.0, 0.0, message.heading_rad),
    )
    measured = _ros("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
    return _ros("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=measured)


def _truth(message: Any, header: Any) -> Any:
    """Return the true pose of a simulated car in its world."""
    header.frame_id = "world"
    pose = _ros(
        "geometry_msgs/msg/Pose",
        position=_vector(message.x_m, message.y_m, of="Point"),
        orientation=_quaternion(0.0, 0.0, message.heading_rad),
    )
    return _ros("geometry_msgs/msg/PoseStamped", header=header, pose=pose)


def _log(message: Any, header: Any) -> Any:
    return _ros(
        "rcl_interfaces/msg/Log",
        stamp=header.stamp,
        level=_LOG_LEVELS.get(message.level, 0),
        name=message.name,
        msg=message.message,
        file=message.file,
        function="",
        line=message.line,
    )


_CONVERTERS: Final[Mapping[str, tuple[str, Callable[[Any, Any], Any]]]] = {
    "fleet.v1.Range": ("sensor_msgs/msg/Range", _range),
    "fleet.v1.Battery": ("sensor_msgs/msg/BatteryState", _battery),
    "fleet.v1.Attitude": ("sensor_msgs/msg/Imu", _attitude),
    "fleet.v1.Wheels": ("sensor_msgs/msg/JointState", _wheels),
    "fleet.v1.Odometer": ("sensor_msgs/msg/JointState", _odometer),
    "fleet.v1.Arm": ("sensor_msgs/msg/JointState", _arm),
    "fleet.v1.Pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", _pose),
    "fleet.v1.Truth": ("geometry_msgs/msg/PoseStamped", _truth),
    "foxglove.Log": ("rcl_interfaces/msg/Log", _log),
}
"""By full name: our messages for which ROS has a standard one."""
_UNFIT: Final = (ValueError, OverflowError, AttributeError, TypeError, struct.error)
"""Errors that say that ROS's message cannot hold a reading: any program can publish an infinite angle, and the schema
of another version may lack a field of ours, or have it with another type."""
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"


def _diagnostics(message: Message, header: Any, key: str) -> Any:
    """Return the fields of a message as text: numbers, lists and nested messages as JSON, times in ns, bytes in hex.

    Leave out unset fields, and those that are in the header or in the name of the topic.
    """
    values = [
        _ros("diagnostic_msgs/msg/KeyValue", key=name, value=value if isinstance(value, str) else json.dumps(value))
        for name, value in plain(message).items()
        if name not in _COMMON
    ]
    status = _ros(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=0,  # OK: a record judges nothing
        name=key,
        message="",
        hardware_id=text_of(message, "car"),
        values=values,
    )
    return _ros(DIAGNOSTICS, header=header, status=[status])


def topic_name(key: str) -> str:
    """Return the topic of a key, without the fleet. Its parts have only letters, digits and _, with no digit first."""
    parsed = keys.parse(key)
    parts = (parsed.car, *parsed.topic.split("/")) if parsed is not None else tuple(key.split("/"))
    if len(parts) > 2 and parts[1] == "sensor":
        parts = (parts[0], *parts[2:])
    words = [re.sub(r"[^A-Za-z0-9_]", "_", part.removeprefix("@")).strip("_") or "x" for part in parts]
    return "/" + "/".join(f"n{word}" if word[0].isdigit() else word for word in words)


class Bag(Struct):
    """Counts and topics of a written bag."""

    messages: int = 0
    topics: dict[str, str] = field(default_factory=dict)
    """Type by topic."""
    left_out: LeftOut = field(default_factory=LeftOut)


def write_bag(rows: Iterable[Row], out: Path) -> Bag:
    """Write the protobuf messages of a session into a new bag, and count the others. Raises OSError."""
    bag, decoder = Bag(), MessageDecoder()
    connections: dict[tuple[str, str], Any] = {}

    def connection_of(key: str, kind: str, writer: Writer) -> Any:
        if (key, kind) not in connections:
            name = topic_name(key)
            free = next(each for each in numbered(name, "_") if each not in bag.topics)
            bag.topics[free] = kind
            connections[key, kind] = writer.add_connection(free, kind, typestore=_STORE)
        return connections[key, kind]

    with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        for info, _, log_ns, publish_ns, payload in rows:
            key = info.channel.topic
            message = decoder.message(info, payload)
            if message is None:
                bag.left_out.add(key, why_not_decoded(decoder, info))
                continue
            kind, cdr = _convert(message, key, publish_ns)
            writer.write(connection_of(key, kind, writer), log_ns, cdr)
            bag.messages += 1
    return bag


def _convert(message: Message, key: str, publish_ns: int) -> tuple[str, Any]:
    """Return the ROS type and the serialized message."""
    kind, convert = _CONVERTERS.get(message.DESCRIPTOR.full_name, (DIAGNOSTICS, None))
    if convert is not None:  # it may change the header that it gets
        try:
            return kind, _STORE.serialize_cdr(convert(message, _header(message, key, publish_ns)), kind)
        except _UNFIT:
            pass
    return DIAGNOSTICS, _STORE.serialize_cdr(_diagnostics(message, _header(message, key, publish_ns), key), DIAGNOSTICS)


def _header(message: Message, key: str, publish_ns: int) -> Any:
    return _ros("std_msgs/msg/Header", stamp=_stamp(message_time_ns(message, publish_ns)), frame_id=_frame(key))


@cache
def _frame(key: str) -> str:
    return topic_name(key)[1:]
