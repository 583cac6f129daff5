"""The fields of the sensors frame, one row each, in wire order: they drive the parser and the mode signatures."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

_BITS_2: Final = {b"%d%d" % (a, b): (bool(a), bool(b)) for a in (0, 1) for b in (0, 1)}
_BITS_4: Final = {left + right: (*_BITS_2[left], *_BITS_2[right]) for left in _BITS_2 for right in _BITS_2}


@dataclass(frozen=True, slots=True)
class SensorField:
    """One field of the sensors frame.

    `measurement` is its name in modes, profiles and conditions, `attribute` its name in `Sensors`. `read` returns None
    for bits that are neither 0 nor 1. `maximum` is the upper end of the range of a number; the lower end is 0.
    """

    measurement: str
    attribute: str
    word: bytes
    pattern: bytes
    read: Callable[[bytes], Any]
    maximum: float | None = None

    def accepts(self, text: bytes) -> bool:
        """Return True if a text that matches the pattern is in range."""
        value = self.read(text)
        return value is not None and (self.maximum is None or value <= self.maximum)


# docs/reference/protocol.md#ranges and docs/reference/protocol.md#spellings. A number is unsigned, with decimals only
# in CSB and PV. Bits
# are digits. `[0-9]` in a bytes pattern is ASCII only.
SENSOR_FIELDS: Final = (
    SensorField("range", "range_cm", b"CSB", rb"[0-9]+(?:\.[0-9]+)?", float, 1200.0),
    SensorField("battery", "voltage_v", b"PV", rb"[0-9]+(?:\.[0-9]+)?", float, 12.0),
    SensorField("grayscale", "grayscale", b"GS", rb"[0-9]+", int, 1023),
    SensorField("line", "line", b"LF", rb"[0-9]{4}", _BITS_4.get),
    SensorField("obstacle", "obstacle", b"HW", rb"[0-9]{2}", _BITS_2.get),
    SensorField("light", "light", b"GM", rb"[0-9]{2}", _BITS_2.get),
)
ATTRIBUTES: Final = {field.measurement: field.attribute for field in SENSOR_FIELDS}


def sensors_pattern(filler: Mapping[str, bytes] | None = None) -> bytes:
    """Return the pattern of a sensors frame without its `#`, one group per field.

    `filler`: the exact text of some fields, by measurement.
    """
    texts = {name: re.escape(text) for name, text in (filler or {}).items()}
    return rb"\$4WD" + b"".join(
        b",%b(%b)" % (field.word, texts.get(field.measurement, field.pattern)) for field in SENSOR_FIELDS
    )
