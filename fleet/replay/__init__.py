"""Shows and replays recordings: in Rerun (`rerun`), on the bus (`player`), through today's code (`analysis`).

Read `panels` first: its tables say which field is drawn how. `colors` and `foxglove_layout` belong to them.
"""
