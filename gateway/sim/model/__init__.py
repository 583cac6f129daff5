"""The simulated cars' pure core: firmware on virtual time, and the world. No I/O, no clock, no randomness."""
