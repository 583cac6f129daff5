"""Stopping a car: frame sequences, the choice among them, and the evidence that shows the stop. Pure."""
