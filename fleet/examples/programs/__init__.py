"""Example programs, each under thirty lines."""
