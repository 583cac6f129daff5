"""A recorded session, shown in Rerun."""
