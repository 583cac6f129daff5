"""What keeps the processes of a fleet running: when (restart.py, pure), how (process.py), what cars show of it."""
