"""Pins of a session: spans of time whose recordings the quota deletes last, each with its cause. Pure.

`pin_watch.py` finds them live, `session.json` stores them, and `quota_choice.py` spares them. If a pin begins before
its session, its first part lies in the session before.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final, Self

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.recording.time_spec import iso, iso_ns
from schemas.words import PinCause

PIN_BEFORE_NS: Final = 30_000_000_000
PIN_AFTER_NS: Final = 30_000_000_000
"""Pinned time before and after a stop or a mark, ns: together one minute."""
MAX_PINS: Final = 500
"""Maximum pins of a session. session.json has 150 bytes for each, and is written once in each second in which a pin
changes. At the limit, a new pin is merged into the newest one of the same cause (and condition), even if the two do not
touch. Only the first pin of a cause or of a condition is still added."""
_MS_NS: Final = 1_000_000


class Pin(Struct, frozen=True):
    """A pinned span of time. Times on the recorder's clock, ns since the epoch."""

    begin_ns: int
    end_ns: int
    cause: str
    """A word of PinCause, or of a newer version."""
    words: str
    """The condition, the first command and its sender, or the text of the mark."""
    cars: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the pin as JSON values."""
        times = {"from": iso(self.begin_ns), "to": iso(self.end_ns + _MS_NS - 1)}
        return {**times, "cause": self.cause, "words": self.words, "cars": list(self.cars)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self | None:
        """Return the pin in these JSON values, or None if they are not a pin."""
        try:
            begin_ns, end_ns = iso_ns(values["from"]), iso_ns(values["to"])
            cars = tuple(str(car) for car in values.get("cars", ()))
            return cls(begin_ns, end_ns, str(values["cause"]), str(values.get("words", "")), cars)
        except (KeyError, ValueError, TypeError, OverflowError):
            return None


def minute_of(at_ns: int, cause: PinCause, words: str, cars: Iterable[str] = ()) -> Pin:
    """Return the pin of the minute around a moment."""
    return Pin(at_ns - PIN_BEFORE_NS, at_ns + PIN_AFTER_NS, cause, words, tuple(cars))


class PinList(Struct):
    """The pins of one session. A new pin is merged into the newest one of its cause (and condition) that it touches."""

    pins: list[Pin] = field(default_factory=list)

    def add(self, pin: Pin) -> bool:
        """Add a pin. Return False if nothing changes."""
        index = self._place_of(pin)
        if index is None:
            self.pins.append(pin)
            return True
        old = self.pins[index]
        self.pins[index] = _merge(old, pin)
        return self.pins[index] != old

    def _place_of(self, pin: Pin) -> int | None:
        """Return the index of the pin into which this one is merged, or None."""
        # Look at the newest first, because it is the likely one.
        same = [index for index in reversed(range(len(self.pins))) if _is_of_one_cause(self.pins[index], pin)]
        touched = (
            index
            for index in same
            if self.pins[index].begin_ns <= pin.end_ns and pin.begin_ns <= self.pins[index].end_ns
        )
        return next(touched, same[0] if same and len(self.pins) >= MAX_PINS else None)


def _is_of_one_cause(one: Pin, other: Pin) -> bool:
    # The words of a stop's pin name the sender, so they differ between stops of two people. Merge these pins all the
    # same. The merged pin keeps the first words.
    return one.cause == other.cause and (one.cause != PinCause.CONDITION or one.words == other.words)


def _merge(old: Pin, new: Pin) -> Pin:
    cars = old.cars if set(new.cars) <= set(old.cars) else tuple(dict.fromkeys((*old.cars, *new.cars)))
    return replace(old, begin_ns=min(old.begin_ns, new.begin_ns), end_ns=max(old.end_ns, new.end_ns), cars=cars)


def pins_of(pins: Iterable[Mapping[str, Any]], marks: Iterable[Mapping[str, Any]]) -> list[Pin]:
    """Return the pins of a session and those of its marks, sorted by time. Leave out values that are not pins."""
    found = [pin for values in pins if (pin := Pin.from_dict(values)) is not None]
    for mark in marks:
        try:
            found.append(minute_of(iso_ns(mark["time"]), PinCause.MARK, str(mark.get("text", ""))))
        except (KeyError, ValueError, TypeError, OverflowError):
            continue
    return sorted(found, key=lambda pin: (pin.begin_ns, pin.end_ns))
