"""A plain Zenoh client that floods one key. Arguments: configuration as JSON, key, payload, seconds. Prints a count."""

import sys
import time

import zenoh

config, key, payload, seconds = sys.argv[1:]
with zenoh.open(zenoh.Config.from_json5(config)) as session:
    sys.stdout.write("begins\n")
    sys.stdout.flush()
    until, count = time.monotonic() + float(seconds), 0
    while time.monotonic() < until:
        for _ in range(100):
            session.put(key, payload, encoding="application/json", congestion_control=zenoh.CongestionControl.BLOCK)
        count += 100
    sys.stdout.write(f"{count}\n")
