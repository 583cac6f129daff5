"""Replays a session on a bus at its own pace. Read `schedule` first, then `player`."""
