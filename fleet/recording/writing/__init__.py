"""Writing a session: the recorder, its segments, rollover, backfill and retention. Read `recorder` first."""
