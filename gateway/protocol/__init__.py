"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

From the car: bytes, `decoder`, `parser`, `events`, `measurements`. To the car: `frames`. Tables: `enums` (words),
`sensor_fields` (one row per field of the sensors frame), `modes` (one row per mode), `timing` and `platforms`.
"""
