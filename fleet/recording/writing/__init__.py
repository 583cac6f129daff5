"""Writes sessions: the recorder, segments, rollover, backfill, quota and disk space. Read `recorder` first."""
