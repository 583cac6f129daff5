"""Debounces conditions: short changes of their values have no effect. Pure; times in s."""

from typing import Final

from msgspec import Struct
from msgspec.structs import replace

HYSTERESIS_S: Final = 1.5
"""Minimum time for which a value must have changed before the change counts."""
UNKNOWN_TIMEOUT_S: Final = 5.0
"""Maximum time for which a true condition may be unknown. A mode change silences a car for 4.5 s
(docs/reference/protocol.md#blocking-times)."""


class Debounced(Struct, frozen=True):
    """A condition that counts as true (`on`), or that has become true, but not yet for long enough."""

    on: bool
    since: float
    """Time at which the condition became true. While `on`, short breaks do not count."""
    otherwise_since: float | None = None
    """Time since which the value has been false or unknown, while `on` still holds. None if the value is true."""


def debounce(before: Debounced | None, value: bool | None, for_s: float, now: float) -> Debounced | None:  # noqa: FBT001 - the value itself
    """Return the new state of a condition.

    It is on after it has been true for `for_s`. Then it ends (None) if it is false, and has not been true for
    HYSTERESIS_S, or if it is unknown, and has not been true for UNKNOWN_TIMEOUT_S.
    """
    if before is None or not before.on:
        if not value:
            return None
        since = now if before is None else before.since
        return Debounced(now - since >= for_s, since)
    if value:
        return before if before.otherwise_since is None else replace(before, otherwise_since=None)
    since = now if before.otherwise_since is None else before.otherwise_since
    if now - since >= (UNKNOWN_TIMEOUT_S if value is None else HYSTERESIS_S):
        return None
    return replace(before, otherwise_since=since)


class Settled(Struct, frozen=True):
    """A boolean that changes only after HYSTERESIS_S of the other value."""

    value: bool
    other_since: float | None = None


def settle(before: Settled | None, value: bool | None, now: float) -> Settled | None:  # noqa: FBT001 - the value itself
    """Follow a boolean. The first value counts at once. An unknown value changes nothing."""
    if value is None or before is None:
        return before if value is None else Settled(value)
    if value is before.value:
        return before if before.other_since is None else Settled(value)
    since = now if before.other_since is None else before.other_since
    return Settled(value) if now - since >= HYSTERESIS_S else Settled(before.value, since)
