"""Exports sessions to Rerun and shows a running fleet there. Read `rrd_export` first.

`live` does the same with a bus.
"""
