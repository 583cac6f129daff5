"""Commands for tests of one link at the desk: `gateway scan`, `monitor` and `send`, and what they share."""
