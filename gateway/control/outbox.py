"""When the next frame may be written: one at a time, none into a block, and what the car's buffer may still hold.

Knows frames and times, not commands; what is to be written is decided by the controller.
"""

from gateway.control.recipes import REPEAT_S, Gate
from gateway.protocol.encode import Frame
from gateway.protocol.profile import Profile

FLIGHT_S = 0.06
"""A frame is in flight for 0.06 s or its block, whichever is longer (protocol.md): a report may be under way."""


class Pacing:
    """The last frame written, and what follows from it. Times are seconds on one monotonic clock."""

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._written_at = float("-inf")
        self._block_s = 0.0
        self.echo_seen = False
        """The last ranging had an echo. False also until a reading has come: the car may be blocked for a second."""

    def wrote(self, frame: Frame, now: float) -> None:
        """A frame was handed to the link."""
        self._written_at = now
        self._block_s = self._profile.block_s(frame)

    def reset(self) -> None:
        """The link is new: nothing of ours is on it, and nothing is known."""
        self._written_at = float("-inf")
        self._block_s = 0.0
        self.echo_seen = False

    @property
    def written_at(self) -> float:
        """When the last frame was written; -inf if none was."""
        return self._written_at

    @property
    def flight_until(self) -> float:
        """Until when the last frame is in flight."""
        return self._written_at + max(FLIGHT_S, self._block_s)

    @property
    def blocked_until(self) -> float:
        """Until when the last frame keeps the car from reporting; -inf if it does not."""
        return self._written_at + self._block_s if self._block_s > FLIGHT_S else float("-inf")

    @property
    def buffer_until(self) -> float:
        """Until when the last frame may lie in the car's buffer unread."""
        if self.echo_seen:
            return self.flight_until
        return self._written_at + REPEAT_S + self._block_s

    def ready_at(self, gate: Gate) -> float:
        """From when on a frame that waits for `gate` may be written."""
        match gate:
            case Gate.NOTHING:
                return float("-inf")
            case Gate.FLIGHT:
                return self.flight_until
            case Gate.ALONE:
                return self.buffer_until

    @property
    def repeat_at(self) -> float:
        """From when on a repetition is alone: 1.1 s after the last frame, or after its block if that is later."""
        return max(self._written_at + REPEAT_S, self.flight_until)
