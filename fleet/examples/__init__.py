"""Example programs, each under thirty lines. CI runs each of them against simulated cars. Nothing imports them."""
