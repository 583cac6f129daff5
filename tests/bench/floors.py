"""The bare processes that ours is compared with, of stock packages alone: `python -m tests.bench.floors WHAT ...`."""

import json
import signal
import sys
import threading

import zenoh


def session(endpoint: str) -> zenoh.Session:
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "timestamping": {"enabled": True},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def wait() -> None:
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    ended.wait()


def relay(endpoint: str, path: str, key: str) -> None:
    """pyserial read and Zenoh put."""
    import serial

    with session(endpoint) as opened, serial.Serial(path, 9600) as port:
        publisher = opened.declare_publisher(key)
        signal.signal(signal.SIGTERM, lambda *_: port.cancel_read())
        while data := port.read(1):
            publisher.put(data + port.read(port.in_waiting))


def answer(endpoint: str, key: str) -> None:
    """A queryable that answers at once."""
    with session(endpoint) as opened:
        queryable = opened.declare_queryable(key, lambda query: query.reply(key, b"ok"))
        wait()
        queryable.undeclare()


def token(endpoint: str, key: str) -> None:
    """A session and a liveliness token."""
    with session(endpoint) as opened:
        held = opened.liveliness().declare_token(key)
        wait()
        held.undeclare()


def record(endpoint: str, expression: str, path: str) -> None:
    """A subscriber callback that calls `add_message`."""
    import time

    from mcap.writer import Writer

    with open(path, "wb") as file, session(endpoint) as opened:  # noqa: PTH123 - a floor is plain
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("all", "protobuf", 0)

        def take(sample: zenoh.Sample) -> None:
            writer.add_message(channel, time.time_ns(), sample.payload.to_bytes(), time.time_ns())

        subscriber = opened.declare_subscriber(expression, take)
        wait()
        subscriber.undeclare()
        writer.finish()


if __name__ == "__main__":
    {"relay": relay, "answer": answer, "token": token, "record": record}[sys.argv[1]](*sys.argv[2:])
