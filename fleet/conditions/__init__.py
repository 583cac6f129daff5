"""Conditions as people write them: `range_m < 0.3 and not light.left`. The command line, the SDK and plans use them.

The caller defines the names and looks up their values; no text is executed. A comparison with a value that was not
measured is unknown (Kleene's logic). Read `expression` (the tree) first, then `condition_parser`, `fields` (names from
messages), `functions` (of fields, one row for each), `holding` (for how long a condition holds) and `satisfiability`
(conditions that can never be true).
"""

from fleet.conditions.condition_parser import BadExpression, parse
from fleet.conditions.expression import Expression, Lookup
from fleet.conditions.fields import aliases_of, compared_in, fields_of, topic_aliases_of, value_in
from fleet.conditions.satisfiability import is_contradictory

__all__ = [
    "BadExpression",
    "Expression",
    "Lookup",
    "aliases_of",
    "compared_in",
    "fields_of",
    "is_contradictory",
    "parse",
    "topic_aliases_of",
    "value_in",
]
