"""An operator that drives one car by `stream` or by `command`, with a token or without, until it is killed.

Arguments: car, how, `token` or `-`, duration_s of each drive, and a verb with its JSON for a command during the drive.
"""

import json
import sys
import time

from schemas import bus, keys, messages

car, how, watched, duration_s, *also = sys.argv[1:]


def ask(opened: bus.Bus, verb: str, payload: bytes) -> None:
    """Send a command, and print the answer."""
    key = keys.command_key("fleet", car, verb)
    for answer in opened.query(key, payload=payload, encoding=messages.JSON, timeout_s=20.0):
        sys.stdout.write(json.dumps(json.loads(answer.payload)) + "\n")
        sys.stdout.flush()


with bus.Bus.open() as opened:
    if watched == "token":
        opened.token(keys.operator_token("fleet", f"stick-{car}"))
        time.sleep(0.3)  # until the gateway has the token
    who = {"sender": f"stick-{car}", "kind": "person"}
    drive = json.dumps({"motion": "forward", "duration_s": float(duration_s)} | who).encode()
    for number in range(1, 100_000):
        if how == "stream":
            opened.put_command(keys.command_key("fleet", car, "drive"), drive, messages.JSON, number)
            time.sleep(0.05)
        else:
            ask(opened, "drive", drive)
            time.sleep(3600)
        if also and number == 10:
            verb, fields = also
            ask(opened, verb, json.dumps(json.loads(fields) | who).encode())
