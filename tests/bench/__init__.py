"""Benchmarks: the cost of each part beside a floor, measured in turns on the same machine (`make bench`).

No test asserts a speed. A person reads the ratios to the floors, on a machine that is otherwise idle.
"""
