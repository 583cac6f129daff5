"""Decides when the next frame may be written, from the blocks of the last frames and the car's buffer.

It knows frames and times, no commands. `Executor` decides which frame is written.
"""

from typing import Final

from gateway.control.stops.sequences import REPEAT_INTERVAL_S, Gate
from gateway.protocol.enums import ServoAction
from gateway.protocol.frames import ArmSet, Frame, General
from gateway.protocol.platform_name import Platform
from gateway.protocol.platforms import Profile, StopStyle

FLIGHT_S: Final = 0.06
"""Minimum time that a frame is in flight; a longer block counts instead (docs/reference/protocol.md#pacing)."""
FRONT_SERVO: Final = frozenset({ServoAction.FRONT_LEFT, ServoAction.FRONT_RIGHT, ServoAction.FRONT_RESET})
# After a report the car ranges again no earlier than 0.85 s later (docs/reference/protocol.md#rates: once a second in
# mode 0). This leaves
# 0.25 s for the delay of the link.
AWAKE_S: Final = 0.6
"""Time after a report in which the car reads a frame at once."""
REPORT_S: Final = 2.2
"""Maximum interval of reports in mode 0: one a second, and 1.0 s more without an echo."""


class Pacing:
    """Tracks the last written frame. Times: s, monotonic."""

    # A ranging without an echo blocks the car for 1.0 s, less than `REPEAT_INTERVAL_S`. A frame then waits unread in
    # the buffer. The car reads it earlier if it was awake at the write, or has sent a report since. Frames that waited
    # before it may then block the car once more. An echo in the last ranging does not predict the next one.

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.reset()

    def reset(self) -> None:
        """Forget everything: the link is new."""
        self._written_at = float("-inf")
        self._block_s = 0.0
        self._sure_s = 0.0
        self._before_s = 0.0
        self._read_by = float("-inf")
        self._reported_at = float("-inf")

    def on_written(self, frame: Frame, now: float) -> None:
        """Record a written frame."""
        awake_at = max(now, self.block_until) if now <= self._reported_at + AWAKE_S else float("inf")
        self._before_s = max(self._before_s, self._block_s) if now < self._read_by else 0.0
        self._read_by = min(awake_at + FLIGHT_S, max(now + REPEAT_INTERVAL_S, self.block_until))
        self._written_at = now
        self._block_s = self.profile.block_s(frame)
        self._sure_s = self._block_s if self._surely_blocks(frame) else 0.0

    def _surely_blocks(self, frame: Frame) -> bool:
        """Return True if the block of this frame is certain on this platform. Other blocks are only possible.

        docs/reference/protocol.md#blocking-times has the certain ones.
        """
        if isinstance(frame, General):
            slow = frame.servo is None or frame.servo in FRONT_SERVO
            return slow and not (frame.fan and self.profile.kind is Platform.UNKNOWN)
        return not isinstance(frame, ArmSet)

    def on_report(self, at: float) -> None:
        """Record a report of mode 0: after it the car reads the waiting frames."""
        self._reported_at = at
        if at >= self._written_at + FLIGHT_S:  # an earlier report was under way when the frame was written
            self._read_by = min(self._read_by, at + self._before_s)

    @property
    def reported_at(self) -> float:
        """Return when the last report of mode 0 arrived; -inf if none has."""
        return self._reported_at

    @property
    def written_at(self) -> float:
        """Return when the last frame was written; -inf if none was."""
        return self._written_at

    @property
    def flight_until(self) -> float:
        """Return the end of the last frame's flight."""
        return self._written_at + max(FLIGHT_S, self._block_s)

    @property
    def buffer_until(self) -> float:
        """Return until when the last frame may be unread, or the next frame may join it in the car's buffer."""
        # A longer block does not matter: after the car has read the frame, the next one is alone in the buffer.
        return max(self._read_by, min(self.flight_until, self._written_at + REPEAT_INTERVAL_S))

    @property
    def block_from(self) -> float:
        """Return the earliest end of the last frame's block."""
        return self._written_at + self._block_s

    @property
    def block_until(self) -> float:
        """Return the latest end of the last frame's block."""
        return self._read_by + self._block_s

    def blocked_at(self, now: float) -> bool:
        """Return True if the car is certainly busy with our last frame, and not ranging with that frame unread."""
        running = self._sure_s > FLIGHT_S and now < self._written_at + self._sure_s
        return running and self._before_s == 0.0 and self.clear_at(now)

    def clear_at(self, now: float) -> bool:
        """Return True if the car will have read all our frames before the next one is sent."""
        return self._read_by <= max(now, self.ready_at(Gate.FLIGHT))

    def ready_at(self, gate: Gate) -> float:
        """Return the earliest time for a frame that waits for `gate`."""
        match gate:
            case Gate.NOTHING:
                return float("-inf")
            case Gate.FLIGHT:
                return self._written_at + max(FLIGHT_S, self._sure_s)  # a merely possible block does not delay it
            case Gate.ALONE:
                return self.buffer_until

    def act_at(self, frame: Frame) -> float:
        """Return the earliest time for the frame of a one-shot."""
        if self.profile.stop_style is StopStyle.RASPBERRY_PI and not isinstance(frame, General):
            return max(self.flight_until, self.buffer_until)  # in one receive behind another it kills the program
        return self.flight_until

    def open_at(self, now: float) -> float:
        """Return when a mode may be opened."""
        # The car must be awake, so that the block begins at once. If no report comes, wait until none is due any more.
        alone = max(now, self.buffer_until, self.flight_until)
        if alone <= self._reported_at + AWAKE_S:
            return alone
        return max(now, self.buffer_until + REPORT_S)

    @property
    def repeat_at(self) -> float:
        """Return the earliest time for a repetition: `REPEAT_INTERVAL_S` after the last frame, and after its block."""
        return max(self._written_at + REPEAT_INTERVAL_S, self.flight_until)
