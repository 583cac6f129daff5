"""Exports sessions to Rerun and shows a running fleet there. Read `export` first; `live` does the same on the bus."""
