"""Plays a session on a bus, at its own pace."""
