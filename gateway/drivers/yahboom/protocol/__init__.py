"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

Bytes from a car pass `decoder`, `parser` and `measurements`. `sensors` has the sensors frame: one row per field, its
reading and its parser. `events` has what else the decoder returns. `frames` encodes what goes to a car.
The other modules are tables: `modes` (one row per mode), `timing` and `platforms`. The words are those of
`schemas.words`, and `schemas.platform_name` parses the name of a platform.
"""
