"""Floor: a loop reads a port and publishes messages like the gateway's. Arguments: endpoint, port, key.

The loop decodes nothing and controls nothing. It publishes a reading and the raw frame for each frame, and five states
a second. It builds, stamps, numbers and puts messages as the gateway does.
"""

import asyncio
import sys
import time
from typing import Any

import serial
import zenoh
from client import opened

from schemas.gen import fleet_v1_pb2 as pb

STATES = 5

endpoint, path, key = sys.argv[1:]


class FloorPublisher:
    def __init__(self, session: zenoh.Session, name: str, priority: zenoh.Priority) -> None:
        encoding = zenoh.Encoding("application/protobuf;bench.Message")
        drop = zenoh.CongestionControl.DROP
        self._out = session.declare_publisher(
            f"{key}/{name}", encoding=encoding, congestion_control=drop, priority=priority
        )
        self._count = 0

    def put(self, message: Any) -> None:
        self._count += 1
        message.stamp.seconds, message.stamp.nanos = divmod(time.time_ns(), 1_000_000_000)
        message.car, message.seq, message.boot_id = "red", self._count, "0123456789abcdef0123456789abcdef"
        self._out.put(message.SerializeToString(), source_info=zenoh.SourceInfo(self._out.id, self._count))


async def main(session: zenoh.Session, port: serial.Serial) -> None:
    readings, frames = (FloorPublisher(session, name, zenoh.Priority.DATA) for name in ("reading", "frame"))
    states = [FloorPublisher(session, str(number), zenoh.Priority.DATA_HIGH) for number in range(STATES)]
    token = session.liveliness().declare_token(f"{key}/alive")

    def read() -> None:
        for frame in port.read(port.in_waiting).split(b"#")[:-1]:
            readings.put(pb.Line(left_outer=True, right_outer=True))
            frames.put(pb.RxFrame(data=frame, verdict="sensors", published=["sensor/line"]))

    asyncio.get_running_loop().add_reader(port.fileno(), read)
    while True:
        await asyncio.sleep(1.0)
        for publisher in states:
            publisher.put(pb.Safety(motors="off", worst_stop_s=1.0))
    token.undeclare()


with opened(endpoint) as opened_session, serial.Serial(path, 9600, timeout=0) as opened_port:
    asyncio.run(main(opened_session, opened_port))
