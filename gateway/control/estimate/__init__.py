"""The estimates of a car that never reports its state: mode, platform, outputs, battery, link, trust. Pure."""
