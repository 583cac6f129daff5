"""Decides when the next frame may be written, from the blocks of the last frames and the car's buffer.

The program on the car is one loop. It reads its serial buffer, acts, measures, reports, and begins again. While it acts
it reads nothing: a whistle or a servo blocks it for a good part of a second, a ranging without an echo for a whole one.
Bytes that arrive meanwhile wait in a buffer of 64 bytes. When the loop reads the buffer, it treats all its bytes as ONE
string. So two frames that waited together are not two commands: one is lost, or, worse, they make a third one that
nobody sent. Most of the hazards in docs/reference/protocol.md have this cause.

So a frame should be alone in the buffer when the car reads it. The difficulty is that the car does not say when it
reads. `Pacing` estimates two times for the last frame. Its *flight* is the time during which it is certainly under way:
60 ms, or its own block if that is longer. The time by which it is *read* is a worst case. If the last report shows that
the car is awake, the car reads the frame at once, else after the longest ranging. Neither is earlier than the end of
the block of a frame that waited before it. A report that was sent after the write shows that the loop has read the
buffer, so the time becomes earlier.

Callers say how careful they must be (`Gate`). A stop waits only for the flight, because a stop that waits for certainty
is late, and its repetitions make up for lost frames. A frame that opens a mode, or that must not be read behind another
frame, waits until it is alone. Blocks that are only possible never delay a stop, but they delay everything that can
wait.

How long frames block is learned from each car (`Learned`), because programs and boards differ. But a block
that is shorter than expected does not count here. This module knows frames and times, but no commands: `Executor`
decides which frame is written.
"""

from enum import IntEnum
from typing import Final

from gateway.drivers.yahboom.estimate.learned import Learned, blocking_kind
from gateway.drivers.yahboom.protocol.frames import ArmSet, Frame, General, LoneHash
from gateway.drivers.yahboom.protocol.platforms import FRONT_SERVO, Profile
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from schemas.words import Platform

FLIGHT_S: Final = 0.06
"""Minimum time of a frame's flight. A longer block counts instead (docs/reference/protocol.md#pacing)."""
AWAKE_S: Final = 0.6
"""Maximum time after a report during which the car reads a frame at once. One interval after the report, it ranges."""
LINK_DELAY_S: Final = 0.3
"""Maximum delay of a report by the link. It shortens the time in which the car is awake."""
AWAKE_WAIT_S: Final = 1.25
"""Maximum wait for a report before a mode is opened: one ranging, which may have just begun, and a margin."""


# On the STM32, a named frame that arrives while a report is sent overwrites the beginning of an unread general frame,
# and the two together can start the car (docs/reference/protocol.md#programs-that-people-have). So leave time for 20 ms
# on the wire, 60 ms, and one report of 48 ms.
NAMED_GAP_S: Final = 0.13
"""Minimum time from any frame but a lone `#` to a named one, which has words, such as `$4WD,PTZ90#`."""


class Gate(IntEnum):
    """The condition for writing a frame."""

    NOTHING = 0
    FLIGHT = 1
    """No frame of ours is in flight."""
    ALONE = 2
    """No frame of ours is in flight or in the car's buffer."""


class Pacing:
    """Tracks the last written frame. Times: s, monotonic."""

    # A ranging without an echo takes 1.0 s, less than `REPEAT_INTERVAL_S`. An echo in the last ranging does not predict
    # the next one.

    def __init__(self, profile: Profile, learned: Learned) -> None:
        self.profile = profile
        self.learned = learned
        self.reset()

    def reset(self) -> None:
        """Forget everything, because the link is new."""
        self._written_at = float("-inf")
        self._framed_at = float("-inf")  # when the last frame that is not a lone `#` was written
        self._block_s = 0.0
        self._sure_block_s = 0.0  # 0 if the block is only possible
        self._earlier_block_s = 0.0  # the longest block of the frames that may have been unread at the last write
        self._read_by = float("-inf")  # the latest time at which the car has read all frames
        self._reported_at = float("-inf")

    def on_written(self, frame: Frame, now: float) -> None:
        """Record a written frame."""
        awake_at = max(now, self.block_until) if now <= self.awake_until else float("inf")
        self._earlier_block_s = max(self._earlier_block_s, self._block_s) if now < self._read_by else 0.0
        self._read_by = min(awake_at + FLIGHT_S, max(now + REPEAT_INTERVAL_S, self.block_until))
        self._written_at = now
        if not isinstance(frame, LoneHash):
            self._framed_at = now
        self._block_s = self.longest_block_s(frame)
        self._sure_block_s = self._block_s if self._surely_blocks(frame) else 0.0

    def longest_block_s(self, frame: Frame) -> float:
        """Return the maximum block of a frame, as expected and as this car has shown."""
        expected_s, kind = self.profile.block_s(frame), blocking_kind(frame)
        return expected_s if kind is None else max(expected_s, self.learned.block_s(kind, expected_s))

    def _surely_blocks(self, frame: Frame) -> bool:
        """Return True if the block of this frame is certain on this platform. Other blocks are only possible.

        docs/reference/protocol.md#blocking-times has the certain ones.
        """
        if isinstance(frame, General):
            slow = frame.servo is None or frame.servo in FRONT_SERVO
            return slow and not (frame.fan and self.profile.kind is Platform.UNKNOWN)
        return not isinstance(frame, ArmSet)

    def on_report(self, at: float) -> None:
        """Record a report of mode 0, after which the car reads the waiting frames."""
        self._reported_at = at
        if at >= self._written_at + FLIGHT_S:  # an earlier report was under way when the frame was written
            self._read_by = min(self._read_by, at + self._earlier_block_s)

    @property
    def _interval_s(self) -> float:
        """The interval of the reports with a sonar echo, as far as it is known."""
        expected_s, no_echo = self.profile.interval_s, self.learned.no_echo
        if no_echo.is_known:  # an interval without an echo is longer by the whole ranging
            expected_s = min(expected_s, no_echo.median_s - self.profile.ranging_s)
        return self.learned.interval_s(expected_s)

    @property
    def awake_until(self) -> float:
        """Return until when the car reads a frame at once, as its last report shows, or -inf if nothing shows it."""
        if not (self.learned.echo.is_known or self.learned.no_echo.is_known):
            return float("-inf")  # the car may range again at once
        return self._reported_at + min(AWAKE_S, max(0.0, self._interval_s - LINK_DELAY_S))

    def earliest_named_at(self, frame: Frame) -> float:
        """Return the earliest time for a named frame, which the car must not read together with the one before it."""
        return float("-inf") if isinstance(frame, General | LoneHash) else self._framed_at + NAMED_GAP_S

    @property
    def written_at(self) -> float:
        """Return when the last frame was written, or -inf if none was."""
        return self._written_at

    @property
    def flight_until(self) -> float:
        """Return the end of the last frame's flight."""
        return self._written_at + max(FLIGHT_S, self._block_s)

    @property
    def buffer_until(self) -> float:
        """Return until when the last frame may be unread, so that the next one could join it in the car's buffer."""
        # A longer block does not matter: after the car has read the frame, the next one is alone in the buffer.
        return max(self._read_by, min(self.ready_at(Gate.FLIGHT), self._written_at + REPEAT_INTERVAL_S))

    @property
    def earliest_block_end(self) -> float:
        """Return the earliest end of the last frame's block."""
        return self._written_at + self._block_s

    @property
    def block_until(self) -> float:
        """Return the latest end of the last frame's block."""
        return self._read_by + self._block_s

    def is_blocked(self, now: float) -> bool:
        """Return True if the car is certainly acting on our last frame, not still ranging with the frame unread."""
        running = self._sure_block_s > FLIGHT_S and now < self._written_at + self._sure_block_s
        return running and self._earlier_block_s == 0.0 and self.has_read_all(now)

    def has_read_all(self, now: float) -> bool:
        """Return True if the car has read all our frames by the time at which the next one can be sent."""
        return self._read_by <= max(now, self.ready_at(Gate.FLIGHT))

    def ready_at(self, gate: Gate) -> float:
        """Return the earliest time for a frame that waits for `gate`."""
        match gate:
            case Gate.NOTHING:
                return float("-inf")
            case Gate.FLIGHT:
                # Do not wait for blocks that are only possible.
                return self._written_at + max(FLIGHT_S, self._sure_block_s)
            case Gate.ALONE:
                return self.buffer_until

    def act_at(self, frame: Frame, *, alone: bool = False) -> float:
        """Return the earliest time for the frame of an action on a part. With `alone`, the car must read it alone."""
        if self.profile.kind is Platform.RASPBERRY_PI and not isinstance(frame, General):
            alone = True  # if the car reads such a frame together with another one, its program dies
        at = max(self.flight_until, self.earliest_named_at(frame))
        return max(at, self.buffer_until) if alone else at

    def open_at(self, now: float, *, can_show: bool) -> float:
        """Return when a mode may be opened."""
        # If the car is awake when the mode is opened, the block begins at once, and the car can later show that it left
        # the mode. So wait for a report, but not for long. Do not wait if the car cannot show its stops.
        alone = max(now, self.buffer_until, self.flight_until, self._framed_at + NAMED_GAP_S)
        if alone <= self.awake_until or not can_show:
            return alone
        return max(now, self.buffer_until + AWAKE_WAIT_S)

    @property
    def repeat_at(self) -> float:
        """Return the earliest time for a repetition: `REPEAT_INTERVAL_S` after the last frame, but not in its block."""
        return max(self._written_at + REPEAT_INTERVAL_S, self.flight_until)
