"""Conditions over the readings of one car, for `find` and the pins of recordings. Pure.

The names are those of plans, and the meaning is that of `Holding`.
"""

from collections.abc import Collection
from typing import Final

from fleet.conditions import BadExpression, Expression, parse
from fleet.conditions.holding import Holding
from fleet.conditions.satisfiability import explain_impossible
from fleet.policy.snapshot import ALIASES, NAMES, topic_of
from schemas.topics import TOPICS

_STALE_NS: Final = {
    topic_of(name): None if (after_s := TOPICS[topic_of(name)].stale_after_s) is None else round(after_s * 1e9)
    for name in NAMES
}


def parse_condition(text: str, functions: Collection[str] = ()) -> Expression:
    """Return a condition over the names of plans. Raises BadExpression, also if it can never be true."""
    expression = parse(text, NAMES, ALIASES, functions)
    if never := explain_impossible(expression):
        raise BadExpression(text, 1, never)
    return expression


def holding_of(expression: Expression) -> Holding:
    """Return an evaluator over the readings of one car. Their sources are topics."""
    return Holding(expression, topic_of, _STALE_NS.__getitem__)
