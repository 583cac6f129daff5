"""Floor: a loop reads a port, and puts two messages for each frame and five a second besides. Arguments: endpoint, port, key.

The sizes are those of the gateway's messages: a reading, a raw frame, and the states.
"""

import asyncio
import sys

import serial
import zenoh
from client import opened

READING, FRAME, STATE = bytes(60), bytes(120), bytes(150)
STATES = 5

endpoint, path, key = sys.argv[1:]


async def main(session: zenoh.Session, port: serial.Serial) -> None:
    publishers = [session.declare_publisher(f"{key}/{name}") for name in ("reading", "frame")]
    states = [session.declare_publisher(f"{key}/state{number}") for number in range(STATES)]
    token = session.liveliness().declare_token(f"{key}/alive")

    def read() -> None:
        data = port.read(port.in_waiting)
        for _ in range(data.count(b"#")):
            publishers[0].put(zenoh.ZBytes(READING))
            publishers[1].put(zenoh.ZBytes(FRAME))

    asyncio.get_running_loop().add_reader(port.fileno(), read)
    while True:
        await asyncio.sleep(1.0)
        for publisher in states:
            publisher.put(zenoh.ZBytes(STATE))
    token.undeclare()


with opened(endpoint) as opened_session, serial.Serial(path, 9600, timeout=0) as opened_port:
    asyncio.run(main(opened_session, opened_port))
