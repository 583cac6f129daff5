"""When the next frame may be written: one at a time, none into a block, and what the car's buffer may still hold.

Knows frames and times, not commands; what is to be written is decided by the controller.
"""

from typing import Final

from gateway.control.stops.sequences import REPEAT_S, Gate
from gateway.protocol.enums import ServoAction
from gateway.protocol.frames import ArmSet, Frame, General
from gateway.protocol.platforms import Platform, Profile, StopStyle

FLIGHT_S: Final = 0.06
"""A frame is in flight for 0.06 s or its block, whichever is longer (docs/reference/protocol.md#pacing): a report may
be under way."""
FRONT_SERVO: Final = frozenset({ServoAction.FRONT_LEFT, ServoAction.FRONT_RIGHT, ServoAction.FRONT_RESET})
AWAKE_S: Final = 0.6
"""A car that has just reported ranges again no sooner than 0.85 s later (docs/reference/protocol.md#pacing); what is
written within this time of a reading is read at once, with 0.25 s left for the link's own delays."""
REPORT_S: Final = 2.2
"""A car in mode 0 that can report does so within this time: once a second, and 1.0 s more without an echo."""


class Pacing:
    """The last frame written, and what follows from it. Times are seconds on one monotonic clock.

    A frame lies unread in the car's buffer while a ranging without echo blocks it: for 1.0 s, so less than `REPEAT_S`.
    It is certainly read sooner if the car was awake when it was written, or has sent a reading since; then those that
    lay there before it may block the car once more. That the last ranging had an echo says nothing of the next.
    """

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.reset()

    def reset(self) -> None:
        """The link is new: nothing of ours is on it, and nothing is known."""
        self._written_at = float("-inf")
        self._block_s = 0.0
        self._sure_s = 0.0
        self._before_s = 0.0
        self._read_by = float("-inf")
        self._heard_at = float("-inf")

    def wrote(self, frame: Frame, now: float) -> None:
        """A frame was handed to the link."""
        awake_at = max(now, self.block_until) if now <= self._heard_at + AWAKE_S else float("inf")
        self._before_s = max(self._before_s, self._block_s) if now < self._read_by else 0.0
        self._read_by = min(awake_at + FLIGHT_S, max(now + REPEAT_S, self.block_until))
        self._written_at = now
        self._block_s = self.profile.block_s(frame)
        self._sure_s = self._block_s if self._surely_blocks(frame) else 0.0

    def _surely_blocks(self, frame: Frame) -> bool:
        """Whether its block has a row for this platform, and is not only allowed for.

        See docs/reference/protocol.md#blocking-times.
        """
        if isinstance(frame, General):
            slow = frame.servo is None or frame.servo in FRONT_SERVO
            return slow and not (frame.fan and self.profile.kind is Platform.UNKNOWN)
        return not isinstance(frame, ArmSet)

    def heard(self, at: float) -> None:
        """A mode-0 reading has come: the car has ranged, and reads what waits."""
        self._heard_at = at
        if at >= self._written_at + FLIGHT_S:  # a sooner one was under way when the frame was written
            self._read_by = min(self._read_by, at + self._before_s)

    @property
    def heard_at(self) -> float:
        """When the last mode-0 reading came; -inf if none did."""
        return self._heard_at

    @property
    def written_at(self) -> float:
        """When the last frame was written; -inf if none was."""
        return self._written_at

    @property
    def flight_until(self) -> float:
        """Until when the last frame is in flight."""
        return self._written_at + max(FLIGHT_S, self._block_s)

    @property
    def buffer_until(self) -> float:
        """Until when the last frame may lie in the car's buffer unread, or is in flight and may still be joined.

        A longer block does not matter: what is written once the frame is read lies in the buffer alone.
        """
        return max(self._read_by, min(self.flight_until, self._written_at + REPEAT_S))

    @property
    def block_from(self) -> float:
        """When the last frame's block ends at the soonest."""
        return self._written_at + self._block_s

    @property
    def block_until(self) -> float:
        """When the last frame's block ends at the latest."""
        return self._read_by + self._block_s

    def blocked_at(self, now: float) -> bool:
        """The last frame's block runs, not only perhaps, and no ranging, in which that frame would lie unread."""
        running = self._sure_s > FLIGHT_S and now < self._written_at + self._sure_s
        return running and self._before_s == 0.0 and self.clear_at(now)

    def clear_at(self, now: float) -> bool:
        """Nothing of ours can be unread when the next frame is written that waits for those in flight."""
        return self._read_by <= max(now, self.ready_at(Gate.FLIGHT))

    def ready_at(self, gate: Gate) -> float:
        """From when on a frame that waits for `gate` may be written."""
        match gate:
            case Gate.NOTHING:
                return float("-inf")
            case Gate.FLIGHT:
                return self._written_at + max(FLIGHT_S, self._sure_s)  # it may lie in a block, if there is one
            case Gate.ALONE:
                return self.buffer_until

    def act_at(self, frame: Frame) -> float:
        """From when on a frame that acts once may be written."""
        if self.profile.stop_style is StopStyle.RASPBERRY_PI and not isinstance(frame, General):
            return max(self.flight_until, self.buffer_until)  # in one receive behind another it kills the program
        return self.flight_until

    def open_at(self, now: float) -> float:
        """When a mode may be opened: awake, so that its block begins at once; or when no reading will come."""
        alone = max(now, self.buffer_until, self.flight_until)
        if alone <= self._heard_at + AWAKE_S:
            return alone
        return max(now, self.buffer_until + REPORT_S)

    @property
    def repeat_at(self) -> float:
        """From when on a repetition is alone: 1.1 s after the last frame, or after its block if that is later."""
        return max(self._written_at + REPEAT_S, self.flight_until)
