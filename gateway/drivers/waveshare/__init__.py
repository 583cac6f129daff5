"""The driver of Waveshare's UGV family: WAVE ROVER, UGV01, UGV02, UGV Rover, UGV Beast. Pure.

`feedback_parser` reads lines, `ugv_platforms` is a table, `driver` does the rest. Facts: docs/reference/waveshare.md.
"""
