"""What the parts cost, each beside the least that the same machine can do at the same moment (`make bench`).

No speed is asserted here or in any test: a ratio to a floor is read by a person, on a machine that is otherwise idle.
"""
