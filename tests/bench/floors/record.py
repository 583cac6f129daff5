"""Floor: a subscriber's callback that calls `add_message`. Arguments: endpoint, key expression, file.

A line on stdin ends it; it answers with its number of messages and the CPU seconds that they cost, as JSON.
"""

import json
import sys
import time

import zenoh
from client import opened
from mcap.writer import Writer

endpoint, expression, path = sys.argv[1:]
channels: dict[str, int] = {}
count = 0


def add(sample: zenoh.Sample) -> None:
    global count
    key = str(sample.key_expr)
    channel = channels.get(key)
    if channel is None:
        channel = channels[key] = writer.register_channel(key, "protobuf", 0)
    published = sample.timestamp.get_time_as_ntp64().as_nanos()
    writer.add_message(channel, time.time_ns(), sample.payload.to_bytes(), published, sample.source_info.source_sn)
    count += 1


with opened(endpoint) as session, open(path, "wb") as file:
    writer = Writer(file)
    writer.start()
    subscriber = session.declare_subscriber(expression, add)
    session.liveliness().get("bench/nobody")  # what was declared is known when this is answered
    print(json.dumps({"ready": True}), flush=True)
    before = time.process_time()
    sys.stdin.readline()
    print(json.dumps({"messages": count, "cpu_s": time.process_time() - before}), flush=True)
    subscriber.undeclare()
    writer.finish()
