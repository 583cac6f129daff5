"""The functions that a condition of a plan, of a pin or of `find` may apply to a field: `rate(range_m) < -0.1`.

Each is one row of ROWS. For a condition, `rate(range.range_m)` is a name like any other, with the range that its row
gives. `fleet.policy.snapshot` evaluates the function. A single message has no earlier readings, so `watch` and `wait`
have no functions.
"""

from collections.abc import Callable, Sequence
from math import inf
from typing import Final, TypeAlias

from msgspec import Struct

Measured: TypeAlias = Sequence[tuple[float, float]]
"""Times (s, of one clock) and values of the newest readings that measured a field, the newest last."""


class ConditionFunction(Struct, frozen=True):
    """One row: a function that computes a number from its only argument, a field that is a number."""

    name: str
    evaluate: Callable[[Measured], float | None]
    """Returns the value of the function, or None if it is not known."""
    readings: int = 1
    """Number of the newest readings that it needs."""
    range: tuple[float, float] = (-inf, inf)
    """Lowest and highest value. They show whether a condition can be true at all."""


def rate(readings: Measured) -> float | None:
    """Return the change of a value per second, between the two newest readings that measured it."""
    if len(readings) < 2:
        return None
    (before_at, before), (last_at, last) = readings[-2:]
    return (last - before) / (last_at - before_at) if last_at > before_at else None


ROWS: Final[tuple[ConditionFunction, ...]] = (ConditionFunction("rate", rate, readings=2),)
FUNCTIONS: Final = {row.name: row for row in ROWS}
"""The functions by name."""
KEPT_READINGS: Final = max(row.readings for row in ROWS)
"""Number of the newest readings of each topic that a function may look at."""


def split_call(name: str) -> tuple[str, str]:
    """Return function and field of a name: (`rate`, `range.range_m`) of `rate(range.range_m)`, else ("", name)."""
    function, _, rest = name.partition("(")
    return (function, rest[:-1]) if rest else ("", name)
