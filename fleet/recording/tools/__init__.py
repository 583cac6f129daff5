"""What can be done with a recorded session: summarize, verify, cut, recover, and export to tables."""
