"""The times and limits of a gateway that its clients count on. Pure.

Each of them stands in two processes: a client waits a little longer than its gateway, and a fleet file has the
gateway's own defaults.
"""

from typing import Final

# ------------------------------------------------------------------ commands

DEFAULT_MAX_DRIVE_S: Final = 10.0
"""Maximum duration of a drive, unless `gateway run --longest-drive` sets another."""
MAX_QUEUE_TIME_S: Final = 15.0
"""Maximum time that a command waits for a busy car: longer than the longest stop, that of a connect to a car that sends
nothing (`stop_in_progress.RECOVERY_WORST_S`, and a turn of obstacle avoidance)."""
MAX_EVIDENCE_TIMEOUT_S: Final = 18.0
"""Maximum time for the evidence of a stop, in addition to its announced worst case: four intervals of the slowest car,
one every 3 s with the longest `MODE00` (`stop_in_progress.SLOWEST_S`). A car of 2.5 s or less has time for five."""
# Without the pause the next sample of a held joystick would restart the car 50 ms after another person's stop.
STREAM_PAUSE_S: Final = 0.5
"""Minimum pause of a drive stream after a stop. A release ends the pause at once."""
SHUTDOWN_S: Final = 16.0
"""Maximum time that a gateway that shuts down waits for its car to show the stop."""
MAX_REASON_LENGTH: Final = 200
"""Maximum characters of an e-stop's reason. The gateway cuts off the rest, so that no e-stop fails for its reason."""
