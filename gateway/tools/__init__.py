"""Bench commands for one link: `gateway scan`, `monitor` and `send`, and what they share."""
