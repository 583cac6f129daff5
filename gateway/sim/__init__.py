"""Simulated cars that behave like the real ones do, hazards included."""
