"""Floor: a process puts the bytes of a serial port on the bus unchanged. Arguments: endpoint, port, key."""

import sys

import serial
import zenoh
from client import opened

endpoint, path, key = sys.argv[1:]
with opened(endpoint) as session, serial.Serial(path, 9600) as port:
    publisher = session.declare_publisher(key)
    token = session.liveliness().declare_token(f"{key}/alive")
    while True:
        data = port.read(1)
        if waiting := port.in_waiting:
            data += port.read(waiting)
        publisher.put(zenoh.ZBytes(data))
