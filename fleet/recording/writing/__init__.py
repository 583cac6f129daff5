"""Writes sessions: the recorder, segments, rollover, backfill and retention. Read `recorder` first."""
