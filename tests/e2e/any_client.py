import os

import zenoh

config = zenoh.Config.from_json5('{mode: "client"}')
config.insert_json5("connect/endpoints", f'["{os.environ.get("FLEET_ENDPOINT", "tcp/127.0.0.1:7447")}"]')
with zenoh.open(config) as session:
    for question, payload in ("sensor/range?format=json", None), ("@cmd/drive", '{"motion": "forward"}'):
        for answer in session.get(f"fleet/red/{question}", payload=payload):
            print(answer.ok.payload.to_string())
