"""The common parts of all processes: startup, standard streams, logs, signals and the guard of the parent."""
