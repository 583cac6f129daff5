"""The lint: checks a plan against the cars that are to carry it out, before anything moves. Pure."""
