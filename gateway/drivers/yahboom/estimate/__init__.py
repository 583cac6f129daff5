"""The estimates of a car that never reports its state: rhythm, mode, platform, outputs. Pure."""
