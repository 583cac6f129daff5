"""Simulated cars that behave like the real ones, hazards included.

`cli` reads the arguments (`car_spec`, `faults`, `world_file`). `simulation` runs the cars of `model` in real time
behind their `endpoints`. `control_channel` carries out commands from stdin, `truth_publisher` publishes the true state.
"""
