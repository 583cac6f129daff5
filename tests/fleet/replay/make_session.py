"""Writes a session of three cars and every message type with mcap's writer: `python make_session.py FILE.mcap`."""

import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message
from mcap.writer import Writer

from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import PROTOBUF

START_NS = 1_790_000_000_000_000_000
CARS = ("blue", "green", "red")
MODES = ("manual", "tracking", "obstacle_avoidance")
COMMANDS = (
    (3.0, "drive", "asked", "forward for 3 s"),
    (3.02, "drive", "sent", ""),
    (3.9, "led", "asked", ""),
    (4.0, "led", "sent", ""),
    (6.1, "stop", "complete", "motors off"),
    (6.5, "mode", "sent", "tracking"),
    (13.0, "mode", "rejected", "the link is down"),
)


LED = pb.LedCommand(r=255, g=0, b=16)


class Made:
    """Writes messages and counts them by key."""

    def __init__(self, path: Path, writer: type[Writer]) -> None:
        self._file = path.open("wb")
        self._writer: Any = writer(self._file)
        self._writer.start()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()

    def put(self, key: str, message: Message, at_s: float) -> None:
        """Write a message with the next number of its key, received 1 ms after this time."""
        at_ns = START_NS + int(at_s * 1e9)
        if message.DESCRIPTOR.full_name.startswith("fleet.v1."):
            given: Any = message
            given.stamp.FromNanoseconds(at_ns)
            given.car, given.seq, given.boot_id = key.split("/")[1], self.counts[key] + 1, "b"
        self.put_as_is(key, message, at_ns, at_ns + 1_000_000)

    def put_as_is(self, key: str, message: Message, publish_ns: int, log_ns: int) -> None:
        name = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "protobuf", messages.descriptor_set(name))
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(key, "protobuf", self._schemas[name])
        self.counts[key] += 1
        payload = message.SerializeToString()
        self._writer.add_message(self._channels[key], log_ns, payload, publish_ns, self.counts[key])

    def close(self) -> None:
        self._writer.finish()
        self._file.close()


def log(car: str, at_s: float, level: int, words: str) -> Log:
    made = Log(level=level, message=words, name=f"{car} demo")  # type: ignore[arg-type]  # an enum is a number here
    made.timestamp.FromNanoseconds(START_NS + int(at_s * 1e9))
    return made


def drive_about(made: Made, car: str, index: int, seconds: int) -> None:
    """Write one car: manual, then tracking, then avoidance, on a circle of its own."""
    base = f"fleet/{car}"
    for tenth in range(seconds * 10):
        at = tenth / 10
        angle = at * 0.35 + index * 2.1
        radius = 0.8 + 0.35 * index
        truth = pb.Truth(mode=mode(at, seconds), motor_left=120, motor_right=150, led="#ff0010" if at > 4 else "off")
        truth.x_m, truth.y_m = radius * math.cos(angle), radius * math.sin(angle)
        truth.heading_rad = angle + math.pi / 2
        made.put(f"{base}/sim/truth", truth, at)
        if mode(at, seconds) == "tracking":
            made.put(f"{base}/sensor/line", pb.Line(left_inner=tenth % 7 < 5, right_inner=tenth % 5 < 3), at)
            frame = pb.RxFrame(
                data=b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#", verdict="sensors", published=["sensor/line"]
            )
            made.put(f"{base}/frame/rx", frame, at)
    for second in range(seconds):
        at = second + 0.03 * index
        now = mode(at, seconds)
        if now == "manual":
            distance = (
                pb.Range(no_echo=True) if second % 7 == 6 else pb.Range(range_m=1 + 0.6 * math.sin(at / 2 + index))
            )
            made.put(f"{base}/sensor/range", distance, at)
            voltage = 8.2 - 0.02 * second - 0.2 * index
            made.put(f"{base}/sensor/battery", pb.Battery(voltage_v=voltage, charge=0.8, level="ok"), at)
            made.put(f"{base}/sensor/grayscale", pb.Grayscale(raw=200 + second), at)
            made.put(f"{base}/sensor/line", pb.Line(left_outer=second % 3 == 0), at)
            made.put(f"{base}/sensor/obstacle", pb.Obstacle(left=second % 4 == 0, right=second % 5 == 0), at)
            made.put(f"{base}/sensor/light", pb.Light(left=second % 2 == 0), at)
            made.put(f"{base}/sensor/imu", pb.Imu(gyro_x_raw=second * 3, accel_z_raw=16384), at)
            made.put(f"{base}/sensor/wheels", pb.Wheels(left_m_s=0.25, right_m_s=-0.25), at)
            made.put(f"{base}/sensor/odometer", pb.Odometer(left_m=second, right_m=-second), at)
            made.put(f"{base}/sensor/attitude", pb.Attitude(yaw_rad=0.1), at)
            pose = pb.Pose(frame="map", x_m=second / 10, y_m=float(index), heading_rad=0.5, xy_std_m=0.02)
            made.put(f"{base}/sensor/pose", pose, at)
            made.put(f"{base}/sensor/arm", pb.Arm(joint_deg=[90, 45, 30, 20, 10, second]), at)
        inferred = "tracking" if now == "tracking" else "manual" if now == "manual" else "unknown"
        verdict = "confirmed" if inferred == now else "assumed"
        made.put(
            f"{base}/state/mode",
            pb.Mode(asked=now, inferred=inferred, verdict=verdict, evidence="shape of 3 frames"),
            at,
        )
        motion = "forward" if 3 <= second < 6 else "stop"
        made.put(f"{base}/state/motion", pb.Motion(motion=motion, source="commanded", speed=0.6), at)
        quiet = "lost" if index == 1 and 8 <= second < 11 else "quiet" if now == "obstacle_avoidance" else "online"
        made.put(f"{base}/state/link", pb.Link(state=quiet, rx_bytes=second * 35, rejects={"truncated": 1}), at)
        safety = pb.Safety(motors="on" if motion == "forward" else "off", worst_stop_s=1.2)
        if second == 3:
            safety.lease.holder = "ann"
        if second in (6, 7):
            safety.hold.by = "ann"
            safety.estops.add(id="1", by="ann", why="too close")
        made.put(f"{base}/state/safety", safety, at)
        made.put(f"{base}/state/health", pb.Health(platform="arduino", loop_lag_s=0.002, cpu=0.01, rss_mb=38), at)
    for at, verb, phase, words in COMMANDS:
        event = pb.CommandEvent(id=f"{car} {verb}", verb=verb, sender="ann", kind="person", phase=phase, words=words)
        if verb == "led" and phase == "asked":
            event.request, event.request_encoding = LED.SerializeToString(), f"{PROTOBUF};fleet.v1.LedCommand"
        made.put(f"{base}/event/command", event, at + 0.1 * index)
        made.put(f"{base}/frame/tx", pb.TxFrame(data=b"$1,0,0,0,0,0,0,0,0#", why="command", written=True), at)
    made.put(f"{base}/event/log", log(car, 0.1, 2, "connected to /dev/pts/3"), 0.1)
    made.put(f"{base}/event/log", log(car, 8.0, 3, "link lost: the port is gone"), 8.0)
    made.put(f"{base}/event/log", log(car, 11.0, 2, "link back; recovery begun"), 11.0)


def world(second: int) -> pb.World:
    """Return a room with a line, a lamp that is switched, and an object that turns."""
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)]
    points = [pb.SimPoint(x_m=x, y_m=y) for x, y in corners]
    walls = [pb.SimWall(begin=points[n - 1], end=points[n]) for n in range(4)]
    line = [pb.SimPoint(x_m=x / 2, y_m=y / 2) for x, y in corners]
    lamp = pb.SimLamp(name="beacon", x_m=1.5, y_m=1.5, on=second % 4 < 2, brightness=1.0, reach_m=1.0)
    box = pb.SimThing(name="box", x_m=-1.2, y_m=1.2, heading_rad=second / 10, width_m=0.4, depth_m=0.2)
    return pb.World(lamps=[lamp], things=[box], walls=walls, line=line)


def mode(at_s: float, seconds: int) -> str:
    return MODES[min(int(at_s / seconds * 3), 2)]


def make(path: Path, seconds: int = 20, writer: type[Writer] = Writer) -> Counter[str]:
    """Write the session. Return the number of messages by key."""
    made = Made(path, writer)
    for index, car in enumerate(CARS):
        drive_about(made, car, index, seconds)
    made.put("fleet/@coordinator/plan", pb.Plan(text="red: tracking\nblue: obstacle_avoidance\n", version="1"), 0.5)
    roles = [pb.Role(name="patrol", cars=["blue"]), pb.Role(name="track", cars=["red", "green"])]
    made.put("fleet/@coordinator/assignment", pb.Assignment(roles=roles), 0.6)
    for at, car, decided, why in (
        (0.7, "red", "mode tracking", "its role is track"),
        (8.5, "green", "none", "link lost"),
    ):
        made.put("fleet/@coordinator/decision", pb.Decision(subject=car, decided=decided, why=why), at)
    for second in range(seconds):
        made.put(
            "fleet/@recorder/status",
            pb.Recording(state="recording", bytes=second * 30_000, messages=second * 100),
            second,
        )
        supervised = pb.Supervised(name="red", kind="gateway", state="running", pid=4711)
        made.put("fleet/@supervisor/status", pb.Supervision(state="running", processes=[supervised]), second)
        made.put("fleet/@sim/world", world(second), second)
    made.put("fleet/@recorder/mark", log("@recorder", 9.0, 2, "here it gets interesting"), 9.0)
    made.put("fleet/@coordinator/log", log("@coordinator internal_error", 9.5, 4, "internal_error while deciding"), 9.5)
    made.close()
    return made.counts


if __name__ == "__main__":
    make(Path(sys.argv[1]))
