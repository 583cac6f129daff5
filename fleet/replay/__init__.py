"""Recordings shown and played: in Rerun (`rerun`), on the bus (`player`), through today's code (`analysis`).

`panels` is the table of which field is drawn how; `colors` and `foxglove_layout` follow from it.
"""
