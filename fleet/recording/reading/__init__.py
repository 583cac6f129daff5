"""Reading sessions and MCAP files, also damaged ones. Read `session` first."""
