"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

Bytes from a car pass `decoder`, `parser` and `measurements`. `events` has what the decoder returns. `frames` encodes
what goes to a car. `platform_name` parses the name of a platform. The other modules are tables: `enums` (words),
`sensor_fields` (one row per field of the sensors frame), `modes` (one row per mode), `timing` and `platforms`.
"""
