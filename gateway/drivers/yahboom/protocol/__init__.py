"""The car's wire protocol, pure. See `docs/reference/protocol.md`.

Bytes from a car pass `frame_splitter`, `frame_parser` and `measurements`. `sensors` has the sensors frame: one row per
field, its reading and its parser. `wire_events` has the other events of the splitter. `frames` encodes the frames to a
car. The other modules are tables: `modes` (one row per mode), `timing` and `platforms`. The words are those of
`schemas.words`, and `schemas.platform_name` parses the name of a platform.
"""
