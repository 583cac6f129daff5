"""Conditions as people write them: `range_m < 0.3 and not light.left`; for the command line, the SDK and plans.

What the names are and where values come from the caller says; nothing is ever executed. What was not measured makes a
comparison neither true nor false, and so what depends on it: Kleene's logic.
"""

from fleet.conditions.expression import Expression, Lookup
from fleet.conditions.fields import fields_of, value_in
from fleet.conditions.parser import BadExpression, parse
from fleet.conditions.satisfiability import contradictory

__all__ = ["BadExpression", "Expression", "Lookup", "contradictory", "fields_of", "parse", "value_in"]
