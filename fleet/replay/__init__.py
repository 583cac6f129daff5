"""Shows and replays recordings: in Rerun (`rerun`), on the bus (`player`), through today's code (`analysis`).

Read `panels` first: its tables say how each field is drawn. `state_colors` and `foxglove_layout` build on these tables.
"""
