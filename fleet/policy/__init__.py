"""What a plan decides for the cars. Pure: readings in, decisions out.

Read `plan.plan` (the values) first, then `rules` (which apply now), `allocation` (who takes which role), `decide` (one
step) and `explain` (the step in words). `snapshot` is what is known of the cars, `state` what lasts between steps.
"""
