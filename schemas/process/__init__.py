"""The common parts of all processes: startup, standard streams, signals and the guard of the parent."""
