"""The times and limits of a gateway that its clients count on. Pure.

Each is used in two processes: a client waits a little longer than its gateway, and a fleet file has the same defaults
as the gateway.
"""

from typing import Final

# ------------------------------------------------------------------ commands

DEFAULT_MAX_DRIVE_S: Final = 10.0
"""Maximum duration of a drive, unless `gateway run --longest-drive` sets another."""
MAX_QUEUE_TIME_S: Final = 15.0
"""Maximum time that a command waits for a busy car. It is longer than the longest stop, which is the one after
connecting to a car that sends nothing (`stop_choice.RECOVERY_WORST_S`, and a turn of obstacle avoidance)."""
MAX_EVIDENCE_TIMEOUT_S: Final = 18.0
"""Maximum time for the evidence of a stop, in addition to its announced worst case: four intervals of the slowest car,
which reports every 3 s, with the longest `MODE00` (`stop_in_progress.SLOWEST_S`). A car with an interval of 2.5 s or
less has time for five reports."""
# Without this silence, the next sample of a held joystick would restart the car 50 ms after another person's stop.
STREAM_SILENCE_S: Final = 0.5
"""Minimum silence of a drive stream after a stop. A release (a drive with motion stop) counts as such a silence at
once."""
SHUTDOWN_S: Final = 16.0
"""Maximum time that a gateway that shuts down waits for its car to show the stop."""
MAX_NAME_LENGTH: Final = 128
"""Maximum characters of a sender's name, or of a command's id."""
MAX_REASON_LENGTH: Final = 200
"""Maximum characters of an e-stop's reason. The gateway cuts off the rest: a long reason must not make an e-stop
fail."""
