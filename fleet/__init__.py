"""Several cars from one laptop: drive, watch, record and replay them."""
