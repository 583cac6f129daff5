"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

From the car: bytes, `decoder`, `parser`, `events`, `measurements`. To the car: `frames`. `enums` and `timing` have the
protocol's values and times, `platforms` what each kind of car can do and measures.
"""
