"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

Bytes from a car pass `decoder`, `parser` and `measurements`. `events` has what the decoder returns. `frames` encodes
what goes to a car. The other modules are tables: `enums` (words), `sensor_fields` (one row per field of the sensors
frame), `modes` (one row per mode), `timing`, `platforms` and `platform_name`.
"""
