"""The driver of Waveshare's UGV family: WAVE ROVER, UGV01, UGV02, UGV Rover, UGV Beast. Pure.

`feedback_parser` turns the lines of such a car into events, `ugv_platforms` is the table of its platforms, `driver`
does the rest. docs/reference/waveshare.md has the facts about these cars, and their sources.
"""
