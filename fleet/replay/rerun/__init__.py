"""Rerun: a session exported or a fleet shown live. Read `export` first; `live` is the same for a running fleet."""
