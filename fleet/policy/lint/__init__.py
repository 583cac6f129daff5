"""The lint: checks a plan against the cars that will carry it out, before anything moves. Pure."""
