"""YAML files whose faults are named with file, line and column, all at once. Not imported by `gateway run`."""
