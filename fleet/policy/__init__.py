"""Decides by a plan what the cars should do. Pure: readings in, decisions out.

Read `plan.plan` (the values) first, then `rules` (which are in force), `role_allocation` (which car takes which role),
`decide` (one step) and `explain` (the step in words). `snapshot` is the knowledge of the cars, `state` lasts between
steps. `lint` checks a plan before anything moves.
"""
