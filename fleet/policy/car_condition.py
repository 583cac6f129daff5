"""Conditions over the readings of one car, for `find` and the pins of recordings. Pure.

The conditions use the names of plans, and `Holding` decides for how long they hold. The recorder feeds `CarCondition`
with live messages, `find` feeds it from files.
"""

from collections.abc import Collection
from typing import Any, Final

from msgspec.structs import replace

from fleet.conditions import BadExpression, Expression, parse
from fleet.conditions.functions import FUNCTIONS, KEPT_READINGS
from fleet.conditions.holding import CLOCK_STEP_S, HeldSpan, HeldStep, Holding
from fleet.conditions.satisfiability import explain_impossible
from fleet.policy.snapshot import ALIASES, NAMES, topic_of, value_of
from schemas.messages import Observation
from schemas.topics import TOPICS

_CLOCK_STEP_NS: Final = round(CLOCK_STEP_S * 1e9)
_STALE_NS: Final = {
    topic_of(name): None if (after_s := TOPICS[topic_of(name)].stale_after_s) is None else round(after_s * 1e9)
    for name in NAMES
}


def parse_condition(text: str) -> Expression:
    """Return a condition over the names of plans. Raises BadExpression if it is wrong, or can never be true."""
    expression = parse(text, NAMES, ALIASES, FUNCTIONS)
    if never := explain_impossible(expression):
        raise BadExpression(text, 1, never)
    return expression


class CarCondition:
    """A condition over the messages of one car. The messages of each topic must come in the order of publishing."""

    def __init__(self, expression: Expression) -> None:
        self._expression = expression
        self._holding = Holding(expression, topic_of, _STALE_NS.__getitem__)
        self._newest: dict[str, tuple[int, Observation]] = {}
        """Time and message by topic."""
        self.topics: Collection[str] = frozenset(map(topic_of, expression.names))
        """The topics that the condition uses."""

    @property
    def span(self) -> HeldSpan | None:
        """The time span for which the condition has held, if that has not ended."""
        return self._holding.span

    def add(self, topic: str, message: Any, at_ns: int) -> HeldStep | None:
        """Add a message of one of `topics`. Return None if the message is older than the newest one of its topic.

        at_ns: the message's own time. If it is more than CLOCK_STEP_S before that of the newest one, somebody has set
        the clock back. The condition is then evaluated from the beginning.
        """
        newest_ns, before = self._newest.get(topic, (at_ns, None))
        ended = None
        if at_ns < newest_ns - _CLOCK_STEP_NS:
            ended, before = self.end(), None
            self._holding = Holding(self._expression, topic_of, _STALE_NS.__getitem__)
            self._newest.clear()
        elif at_ns < newest_ns:
            return None
        earlier = () if before is None else (*before.earlier, replace(before, earlier=()))
        seen = Observation(message, at_ns / 1e9, earlier[1 - KEPT_READINGS :])
        self._newest[topic] = at_ns, seen
        step = self._holding.add(topic, lambda name: value_of(name, seen), at_ns)
        return step._replace(ended=step.ended or ended)

    def end(self) -> HeldSpan | None:
        """End the time span for which the condition has held, and return that span."""
        return self._holding.end()
