"""What is believed of a car that never reports its state: mode, platform, outputs, battery, link and trust. Pure."""
