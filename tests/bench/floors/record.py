"""Floor: a subscriber's callback that calls `add_message`. Arguments: endpoint, key expression, file.

A line on stdin has the number of published messages. The process ends when it has received that many, or after ten
seconds. It prints its number of messages and their CPU time, s, as JSON.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path

import zenoh
from client import opened
from mcap.reader import make_reader
from mcap.writer import Writer

endpoint, expression, path = sys.argv[1:]
channels: dict[str, int] = {}
added: Counter[int] = Counter()


def add(sample: zenoh.Sample) -> None:
    key = str(sample.key_expr)
    channel = channels.get(key)
    if channel is None:
        channel = channels[key] = writer.register_channel(key, "protobuf", 0)
    published = sample.timestamp.get_time_as_ntp64().as_nanos()
    writer.add_message(channel, time.time_ns(), sample.payload.to_bytes(), published, sample.source_info.source_sn)
    added[channel] += 1


with opened(endpoint) as session, Path(path).open("wb") as file:
    writer = Writer(file)
    writer.start()
    subscriber = session.declare_subscriber(expression, add)
    list(session.liveliness().get("bench/nobody"))  # the hub answers after it has the subscription
    print(json.dumps({"ready": True}), flush=True)
    before = time.process_time()
    published = int(sys.stdin.readline())
    deadline = time.monotonic() + 10.0
    while added.total() < published and time.monotonic() < deadline:
        time.sleep(0.02)
    cpu_s = time.process_time() - before
    subscriber.undeclare()
    writer.finish()  # type: ignore[no-untyped-call]
with Path(path).open("rb") as written:
    count = make_reader(written).get_summary().statistics.message_count
print(json.dumps({"messages": count, "cpu_s": cpu_s}), flush=True)
