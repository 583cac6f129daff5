"""The values that one page plots, kept until they are sent. Pure."""

from collections.abc import Sequence
from functools import cache
from typing import Any, Final

from msgspec import Struct

from fleet.conditions import fields_of, value_in
from fleet.console.page_requests import BadPageMessage, PageMessage
from schemas import messages, topics

MAX_SERIES: Final = 80
"""Maximum number of series of a page: four plots of twenty cars."""
MAX_BUFFERED_VALUES: Final = 200_000
"""Maximum number of values that wait for one page. While a page reads nothing, further values are dropped."""


class Series(Struct, frozen=True):
    """One field of one topic of one car, over time."""

    car: str
    topic: str
    field: str


@cache
def plottable() -> tuple[tuple[str, str, str], ...]:
    """Return topic, field and unit of every field that is a number, or a bool that can be plotted."""
    return tuple(
        (topic.name, name, topic.units.get(name, ""))
        for topic in topics.CAR_TOPICS
        if topic.family in ("sensor", "state")
        for name, kind in fields_of(messages.message_class(topic.message)).items()
        if kind in (float, bool) and name != "seq"
    )


class PlotBuffer:
    """The series of one page, with the values that the page does not have yet."""

    def __init__(self, series: Sequence[Series]) -> None:
        self._numbers: dict[tuple[str, str], list[tuple[int, str]]] = {}
        for number, each in enumerate(series):
            self._numbers.setdefault((each.car, each.topic), []).append((number, each.field))
        self._values: dict[int, list[tuple[int, float]]] = {}
        self._count = 0

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Car and topic of all series."""
        return list(self._numbers)

    def add(self, car: str, topic: str, message: Any, at_ms: int | None = None) -> None:
        """Add the values of a message, at its stamp if `at_ms` is None. A field that was not measured adds no value."""
        for number, field in self._numbers.get((car, topic), ()):
            value = value_in(message)(field)
            if isinstance(value, int | float) and self._count < MAX_BUFFERED_VALUES:
                stamp_ms = messages.stamp_ms(message.stamp) if at_ms is None else at_ms
                self._values.setdefault(number, []).append((stamp_ms, round(float(value), 4)))
                self._count += 1

    def take(self) -> dict[int, list[tuple[int, float]]]:
        """Return the values by the number of their series, and remove them here."""
        values, self._values, self._count = self._values, {}, 0
        return values


def series_of(message: PageMessage) -> list[Series]:
    """Return what to plot, perhaps nothing. Raises BadPageMessage."""
    value = message.fields.get("series")
    if not isinstance(value, list) or len(value) > MAX_SERIES:
        raise BadPageMessage(f"series is not a list of at most {MAX_SERIES}")
    allowed = {(topic, field) for topic, field, _ in plottable()}
    found = []
    for each in value:
        if not isinstance(each, list) or len(each) != 3 or not all(isinstance(part, str) for part in each):
            raise BadPageMessage("a series is not car, topic and field")
        car, topic, field = each
        if (topic, field) not in allowed:
            raise BadPageMessage(f"{topic} {field} cannot be plotted")
        found.append(Series(PageMessage({"cars": [car]}).cars()[0], topic, field))
    return found
