"""Programs to start from, each under thirty lines; CI runs each against simulated cars. Nothing imports them."""
