"""An operator for one car until it is killed: drives by `stream` or by `command`, watched by its token or not.

Arguments: car, how, `token` or `-`, duration_s of each drive; a verb and its JSON, to be asked once it drives.
"""

import json
import sys
import time

from schemas import bus, keys, messages

car, how, watched, duration_s, *also = sys.argv[1:]


def ask(opened: bus.Bus, verb: str, payload: bytes) -> None:
    """Give a command, and show the answer."""
    key = keys.command_key("fleet", car, verb)
    for answer in opened.query(key, payload=payload, encoding=messages.JSON, timeout_s=20.0):
        sys.stdout.write(json.dumps(json.loads(answer.payload)) + "\n")
        sys.stdout.flush()


with bus.Bus.open() as opened:
    if watched == "token":
        opened.token(keys.operator_token("fleet", f"stick-{car}"))
        time.sleep(0.3)  # what it does after this is watched
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
