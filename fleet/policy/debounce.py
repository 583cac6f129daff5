"""What is so for long enough, and no longer so for long enough: nothing follows a flicker. Pure; times in s."""

from dataclasses import dataclass, replace
from typing import Final

HYSTERESIS_S: Final = 1.5
"""So long what was so must be otherwise before it counts (issue 5, coordinator)."""
BLIND_S: Final = 5.0
"""So long it may be unknown: a car that changes its mode says nothing while it does, 1 + 3.5 s
(docs/reference/protocol.md#blocking-times)."""


@dataclass(frozen=True, slots=True)
class Debounced:
    """Something that is so, or (not `on`) is about to be."""

    on: bool
    since: float
    """Since when it was so without a break."""
    otherwise_since: float | None = None


def follow(before: Debounced | None, so: bool | None, for_s: float, now: float) -> Debounced | None:  # noqa: FBT001 - the fact itself
    """It counts once it was so for `for_s`, until it was not for HYSTERESIS_S or unknown for BLIND_S: then None."""
    if before is None or not before.on:
        if not so:
            return None
        since = now if before is None else before.since
        return Debounced(now - since >= for_s, since)
    if so:
        return before if before.otherwise_since is None else replace(before, otherwise_since=None)
    since = now if before.otherwise_since is None else before.otherwise_since
    if now - since >= (BLIND_S if so is None else HYSTERESIS_S):
        return None
    return replace(before, otherwise_since=since)


@dataclass(frozen=True, slots=True)
class Settled:
    """A yes or no that changes only after HYSTERESIS_S of the other."""

    value: bool
    other_since: float | None = None


def settle(before: Settled | None, so: bool | None, now: float) -> Settled | None:  # noqa: FBT001 - the fact itself
    """The first answer counts at once; unknown leaves what was."""
    if so is None or before is None:
        return before if so is None else Settled(so)
    if so is before.value:
        return before if before.other_since is None else Settled(so)
    since = now if before.other_since is None else before.other_since
    return Settled(so) if now - since >= HYSTERESIS_S else Settled(before.value, since)
