"""A sender with a token that streams drives until it is killed. Each drive would last ten seconds."""

import itertools
import time

from schemas import bus, keys, messages

with bus.Bus.open() as opened:
    opened.token(keys.operator_token("fleet", "stick"))
    time.sleep(0.2)  # until the gateway has the token
    for number in itertools.count(1):
        drive = b'{"motion": "forward", "duration_s": 10, "sender": "stick", "kind": "person"}'
        opened.put_command("fleet/red/@cmd/drive", drive, messages.JSON, number)
        time.sleep(0.05)
