"""The fleet file: its models, reading and editing it, writing a first one from a scan, and checking its links."""
