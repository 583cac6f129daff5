"""Conditions as people write them: `range_m < 0.3 and not light.left`; for the command line, the SDK and plans.

What the names are and where values come from the caller says; nothing is ever executed. What was not measured makes a
comparison neither true nor false, and so what depends on it: Kleene's logic.
"""

from fleet.expression.contradiction import contradictory
from fleet.expression.fields import fields_of, value_in
from fleet.expression.reader import BadExpression, parse
from fleet.expression.tree import Expression, Lookup

__all__ = ["BadExpression", "Expression", "Lookup", "contradictory", "fields_of", "parse", "value_in"]
