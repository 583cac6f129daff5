"""An operator that publishes drives. Arguments: kind, publications a second, seconds. It prints their number."""

import json
import os
import sys
import time

from schemas import bus, keys, messages

os.nice(10)  # operators have computers of their own, and take no time from the gateway's
kind, rate, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
drives = [
    json.dumps({"motion": motion, "duration_s": 0.5, "sender": f"flood-{kind}", "kind": kind}).encode()
    for motion in ("forward", "back", "left", "right")
]
with bus.Bus.open() as opened:
    key = keys.command_key("fleet", "red", "drive")
    began, number = time.monotonic(), 0
    while (now := time.monotonic() - began) < seconds:
        while number < min(now, seconds) * rate:
            opened.put_command(key, drives[number % 4], messages.JSON, number)
            number += 1
        time.sleep(0.002)  # in bursts, as on a busy machine
    sys.stdout.write(f"{number}\n")
