"""One process of the fleet: its start, its standard streams, its signals, its state directory, its parent."""
