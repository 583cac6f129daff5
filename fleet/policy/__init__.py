"""Decides by a plan what the cars should do. Pure: readings in, decisions out.

Read `plan.plan` (the values) first, then `rules_in_force`, `rule_effects` (what they do), `phases` (which phase),
`barriers` (why a car is left alone), `role_allocation` (which car gets which role), `decide` (one step) and `explain`
(the step in words). `snapshot` is what is known about the cars, `state` lasts from one step to the next. `lint` checks
a plan before anything moves.
"""
