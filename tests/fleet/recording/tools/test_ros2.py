"""A ROS 2 bag of a session, read back by the reader of rosbags."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from fleet.cli import cli
from fleet.recording.reading.message_decoder import message_of
from fleet.recording.reading.session import Session
from fleet.recording.tools.ros2 import DIAGNOSTICS, topic_name, write_bag
from schemas import messages
from tests.fleet.recording.tools import every_type
from tests.support import random_session
from tests.support.random_session import START_NS, Mixed

STORE = get_typestore(Stores.ROS2_JAZZY)


def read(bag: Path) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time and message of each message."""
    with Reader(bag) as reader:
        return [
            (each.topic, each.msgtype, at_ns, STORE.deserialize_cdr(data, each.msgtype))
            for each, at_ns, data in reader.messages()
        ]


def test_each_type_is_a_standard_message_with_stamp_and_frame(tmp_path: Path) -> None:
    every_type.make(tmp_path / "one.mcap")
    session = Session(tmp_path / "one.mcap")
    bag = write_bag(session.rows(), tmp_path / "bag")
    found = read(tmp_path / "bag")
    recorded = list(session.rows())
    protobuf = [row for row in recorded if message_of(row[0])]
    assert len(found) == bag.messages == len(protobuf)
    assert bag.messages + bag.left_out.total == len(recorded)
    assert Counter(at_ns for _, _, at_ns, _ in found) == Counter(row[2] for row in protobuf)
    assert all(each.header.frame_id for _, kind, _, each in found if kind != "rcl_interfaces/msg/Log")
    assert {kind for _, kind, _, _ in found} == {
        DIAGNOSTICS,
        "sensor_msgs/msg/Range",
        "sensor_msgs/msg/BatteryState",
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "rcl_interfaces/msg/Log",
    }


def write(path: Path, *rows: tuple[str, str, dict[str, Any]]) -> Path:
    """Write a session of these messages: key, type and fields."""
    made = Mixed(path)
    for key, name, fields in rows:
        message: Any = messages.message_class(name)(**fields)
        message.stamp.FromNanoseconds(START_NS + 5)
        made.put(key, name, message.SerializeToString())
    made.close()
    return path


@pytest.mark.parametrize(
    ("fields", "metres"), [({"range_m": 1.25}, 1.25), ({"no_echo": True}, math.inf), ({}, math.nan)]
)
def test_distance_that_was_not_measured_is_none(fields: dict[str, Any], metres: float, tmp_path: Path) -> None:
    path = write(tmp_path / "one.mcap", ("fleet/red/sensor/range", "fleet.v1.Range", fields))
    write_bag(Session(path).rows(), tmp_path / "bag")
    ((topic, _, _, message),) = read(tmp_path / "bag")
    assert topic == "/red/range"
    assert message.header.frame_id == "red/range"
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == START_NS + 5
    assert message.range == metres or (math.isnan(message.range) and math.isnan(metres))


def test_ros2_attitude_is_rotation_with_unmeasured_marked(tmp_path: Path) -> None:
    row = ("fleet/red/sensor/attitude", "fleet.v1.Attitude", {"yaw_rad": math.pi / 2})
    write_bag(Session(write(tmp_path / "one.mcap", row)).rows(), tmp_path / "bag")
    ((_, _, _, message),) = read(tmp_path / "bag")
    turned = message.orientation
    assert (turned.x, turned.y, turned.z, turned.w) == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))
    assert message.angular_velocity_covariance[0] == message.linear_acceleration_covariance[0] == -1


def test_ros2_pose_keeps_frame_and_error(tmp_path: Path) -> None:
    fields = {"frame": "map", "x_m": 1.5, "y_m": -2.0, "heading_rad": math.pi / 2, "xy_std_m": 0.1}
    write_bag(
        Session(write(tmp_path / "one.mcap", ("fleet/red/sensor/pose", "fleet.v1.Pose", fields))).rows(),
        tmp_path / "bag",
    )
    ((topic, _, _, message),) = read(tmp_path / "bag")
    assert (topic, message.header.frame_id) == ("/red/pose", "map")
    place, turned = message.pose.pose.position, message.pose.pose.orientation
    assert (place.x, place.y, turned.z, turned.w) == pytest.approx((1.5, -2.0, math.sqrt(0.5), math.sqrt(0.5)))
    known = {at: each for at, each in enumerate(message.pose.covariance) if each}
    assert known == pytest.approx({0: 0.01, 7: 0.01})


@pytest.mark.parametrize(
    ("topic", "name", "fields"),
    [
        ("attitude", "fleet.v1.Attitude", {"yaw_rad": math.inf}),
        ("pose", "fleet.v1.Pose", {"xy_std_m": 1e300}),
        ("battery", "fleet.v1.Battery", {"voltage_v": 1e300}),
    ],
)
def test_number_that_ros_cannot_hold_is_text(topic: str, name: str, fields: dict[str, Any], tmp_path: Path) -> None:
    """One such message of any program on the bus ended the export with a traceback."""
    rows = [(f"fleet/red/sensor/{topic}", name, each) for each in ({}, fields, {})]
    bag = write_bag(Session(write(tmp_path / "one.mcap", *rows)).rows(), tmp_path / "bag")
    assert bag.messages == 3
    ((other, message),) = [(at, each) for at, kind, _, each in read(tmp_path / "bag") if kind == DIAGNOSTICS]
    assert other == f"/red/{topic}_2"
    (value,) = [each.value for each in message.status[0].values if each.key in fields]
    assert float(value.strip('"')) in fields.values()


def test_message_without_ros_type_becomes_diagnostic_status(tmp_path: Path) -> None:
    row = ("fleet/red/state/mode", "fleet.v1.Mode", {"car": "red", "asked": "tracking", "candidates": ["a", "b"]})
    write_bag(Session(write(tmp_path / "one.mcap", row)).rows(), tmp_path / "bag")
    ((topic, _, _, message),) = read(tmp_path / "bag")
    (status,) = message.status
    values = {each.key: each.value for each in status.values}
    assert (topic, status.hardware_id) == ("/red/state/mode", "red")
    assert (values["asked"], values["candidates"]) == ("tracking", '["a", "b"]')


@pytest.mark.parametrize(
    ("key", "topic"),
    [
        ("fleet/red/sensor/range", "/red/range"),
        ("fleet/red-2/state/mode", "/red_2/state/mode"),
        ("fleet/2/sensor/range", "/n2/range"),
        ("fleet/@supervisor/status", "/supervisor/status"),
        ("somebody/else's/key", "/else_s/key"),
    ],
)
def test_topic_names(key: str, topic: str) -> None:
    assert topic_name(key) == topic


def test_keys_with_one_name_are_topics_of_their_own(tmp_path: Path) -> None:
    rows = [(f"fleet/{car}/sensor/range", "fleet.v1.Range", {"range_m": 1.0}) for car in ("a-b", "a_b")]
    write_bag(Session(write(tmp_path / "one.mcap", *rows)).rows(), tmp_path / "bag")
    assert sorted(topic for topic, *_ in read(tmp_path / "bag")) == ["/a_b/range", "/a_b/range_2"]


def test_command_writes_a_new_directory(tmp_path: Path) -> None:
    every_type.make(tmp_path / "one.mcap")
    arguments = ["sessions", "export", str(tmp_path / "one.mcap"), "--ros2", str(tmp_path / "bag")]
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    assert read(tmp_path / "bag")
    again = CliRunner().invoke(cli, arguments)
    assert again.exit_code == 2
    assert sorted(each.name for each in tmp_path.iterdir()) == ["bag", "one.mcap"]


def test_nothing_for_a_bag_is_a_failure_that_leaves_nothing(tmp_path: Path) -> None:
    Mixed(tmp_path / "none.mcap").close()
    arguments = ["sessions", "export", str(tmp_path / "none.mcap"), "--ros2", str(tmp_path / "bag")]
    assert CliRunner().invoke(cli, arguments).exit_code == 1
    assert [each.name for each in tmp_path.iterdir()] == ["none.mcap"]


@pytest.mark.parametrize("seed", range(20))
def test_every_message_is_in_the_bag_or_named(seed: int, tmp_path: Path) -> None:
    random_session.make(tmp_path / "one.mcap", seed)
    session = Session(tmp_path / "one.mcap")
    bag = write_bag(session.rows(), tmp_path / "bag")
    assert bag.messages + bag.left_out.total == len(list(session.rows()))
    assert len(read(tmp_path / "bag")) == bag.messages
