"""Tools for recorded sessions: summarize, verify, cut, recover, and export to tables."""
