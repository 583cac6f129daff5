"""Reads sessions and MCAP files, also damaged ones. Read `session` first, then `mcap_reader`."""
