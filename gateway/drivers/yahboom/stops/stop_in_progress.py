"""Tracks a stop in progress: the frames of its tries, and the time to wait for evidence. Pure: time is an argument."""

from typing import Final

from msgspec import Struct, field

from gateway.control.command_records import Pending
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.pacing import FLIGHT_S, Pacing
from gateway.drivers.yahboom.protocol.frames import Frame, ModeClose
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.timing import RECOVERY_SILENCE_S, REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stops import cases, sequences
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.drivers.yahboom.stops.sequences import StopSequence
from gateway.drivers.yahboom.stops.stop_choice import AVOIDING_TURN_S, WIRE_S
from schemas.limits import MAX_EVIDENCE_TIMEOUT_S
from schemas.words import FrameOrigin

EVIDENCE_TIMEOUT_S: Final = 12.0
"""Timeout for the evidence of a stop, in addition to its announced worst case. After that the command fails."""
EVIDENCE_INTERVALS: Final = 5
"""Minimum of the timeout for the evidence, as a number of block gaps (intervals that the block of `MODE00` has made
longer): three that may be needed (because one may be in doubt), one for the report before them, and one for the silence
after them. The maximum of the timeout is `MAX_EVIDENCE_TIMEOUT_S`."""
MAX_ANNOUNCED_WORST_S: Final = 5.0
"""Maximum of the worst case that is added to the timeout for the evidence, so that nobody waits longer than 17 s for an
answer, or 23 s with the slowest car. If a silence that may show the stop has just begun, its end is awaited, too."""
# The silence between two tries is longer than any block outside obstacle avoidance, so the car reads the next frame
# alone. Except on a slow car, it becomes 6.5 s at most, so the car reads at least one of two tries within 15 s after
# the end of a fault.
RETRY_S: Final = (RECOVERY_SILENCE_S, 4.5, 5.5, 6.5)
"""Minimum intervals from `MODE00` to the next try, by the number of tries."""
SLOWEST_S: Final = 3.0
"""Interval of the slowest car. It is used if a report has arrived, but the rhythm of this car is not known."""
REPORT_MARGIN_S: Final = 0.1
"""Margin of the wait for a report after the last frame of a try."""
HELD_UP_S: Final = REPEAT_INTERVAL_S
"""Maximum time for which a stream of actions holds up the next frame of a stop that is being repeated."""


def evidence_s(profile: Profile, learned: Learned) -> float:
    """Return how many seconds to wait for the evidence of a stop, after the time that the stop takes at worst."""
    intervals_s = EVIDENCE_INTERVALS * (learned.echo.median_s + learned.close_s(profile.close_s))
    return min(max(EVIDENCE_TIMEOUT_S, intervals_s), MAX_EVIDENCE_TIMEOUT_S)


def report_wait_s(profile: Profile, learned: Learned, *, slowest: bool = False) -> float:
    """Return the longest time, in s, from the last frame of a try to the next report of a car that has obeyed.

    With `slowest`, the rhythm of the car is not known, so assume the slowest car.
    """
    # If there is no echo, the car ranges before it reads the frame, is blocked, and ranges again before it reports.
    interval_s = learned.interval_s(SLOWEST_S if slowest else profile.interval_s)
    return 2 * profile.ranging_s + learned.close_s(profile.close_s) + interval_s + REPORT_MARGIN_S


class StopInProgress(Struct):
    """A stop in progress: the frames of its current try, and the commands that end with it. Times: s, monotonic.

    A stop ends on evidence (see evidence.py), or as its case allows. After its last frame it waits for a report, then
    tries again.
    """

    sequence: StopSequence
    why: FrameOrigin
    began_at: float
    try_at: float
    """When the current try begins. Frames of other commands put it off."""
    commands: list[Pending] = field(default_factory=list)

    # The current try.
    index: int = 0
    """Number of frames of the current try that are written."""
    try_decided_at: float = float("-inf")
    """When the current try was decided on."""
    tries: int = 1
    """Number of tries until now. Probes do not count, nor tries for a command that has joined the stop."""
    report_wait_s: float = 0.0
    """Minimum wait for a report after the last frame of a try, by the function of this name."""
    due: float = float("inf")
    """When the next step is due, by the last call of `due_at`. If its frame is written later, our loop was late."""

    # The frames until now.
    first_at: float | None = None
    """When the first frame of the stop was written."""
    last_at: float = float("-inf")
    """When the last frame of the stop was written."""
    closed_at: float = float("-inf")
    """When the newest `MODE00` was written."""
    may_be_lost: bool = False
    """True if the car may have read the last frame of the stop behind another one, and ignored it."""
    other_at: float = float("-inf")
    """When the last frame of another command was written during the stop."""
    sent_once: bool = False
    """True once a whole try was written, whichever try is under way now. A report that arrives after the block of a
    `MODE00` counts as much: the car is in mode 0, and reads frames."""

    # The reports until now.
    report_at: float = float("-inf")
    """Arrival of the last report of mode 0 that the car sent after the newest `MODE00`."""
    no_echo_at: float = float("-inf")
    """Arrival of the last report without an echo that the car sent after the newest `MODE00`. A single one may be
    corrupted, so two are needed."""
    without_echo: int = 0
    """Number of reports without an echo in this stop, except those that came in the block of a `MODE00`."""
    probes: int = 0
    """Number of probes in this stop, and of reports that came on time although a `MODE00` should have delayed them."""

    # The end of the stop.
    case: StopCase = cases.MANUAL
    """The case of the stop: it decides when the stop may end if the car does not show it."""
    worst_at: float = float("-inf")
    """The time by which the motors are off, if all steps are in time and all frames arrive."""
    timeout_s: float = EVIDENCE_TIMEOUT_S
    """Timeout for the evidence, from the arrival of each command."""
    overdue: bool = False
    """True if the car did not show the stop in time. The gateway continues to send it."""

    # The reason for it.
    mode_command: Pending | None = None
    """The mode command for which this stop is sent first."""
    repeats: bool = False
    """True if this stop repeats one whose first frames are written already. Then a command may replace it at once."""

    @property
    def try_sent(self) -> bool:
        """Return True if all frames of the current try are written."""
        return self.index >= len(self.sequence.steps)

    @property
    def is_soft(self) -> bool:
        """Return True if the stop is the end of a drive."""
        return self.sequence.rank == sequences.SOFT.rank

    @property
    def frame(self) -> Frame:
        """Return the frame of the next step."""
        return self.sequence.steps[self.index].frame

    def due_at(self, pacing: Pacing) -> float:
        """Return when the next step is due."""
        step = self.sequence.steps[self.index]
        due = (self.try_at if self.index == 0 else max(self.last_at, self.other_at)) + step.after_s
        self.due = max(due, pacing.ready_at(step.gate), pacing.earliest_named_at(step.frame))
        return self.due

    @property
    def obeys_by(self) -> float:
        """Return the time by which the car has obeyed, if the frames arrived."""
        return max(self.last_at, self.worst_at)

    @property
    def next_try_at(self) -> float:
        """Return the time of the next try, if the car has not shown the stop before."""
        after = self.closed_at if self.closed_at > float("-inf") else self.last_at
        # The frame of another command may delay the report. But a stream of them must not delay the next try for ever.
        last_at = max(self.last_at, min(self.other_at, self.last_at + HELD_UP_S))
        return max(last_at + self.report_wait_s, after + RETRY_S[min(self.tries, len(RETRY_S)) - 1])

    def try_due_at(self, pacing: Pacing) -> float:
        """Return when the next try may begin, if the car has not shown the stop before."""
        # If the car read `MODE00` in one string with a servo frame before it, it would take the digits of that frame.
        follows_action = self.other_at > self.last_at
        return max(self.next_try_at, pacing.buffer_until if follows_action else pacing.flight_until)

    @property
    def goes_first_at(self) -> float:
        """Return when the next frame of the stop goes before a stream of actions."""
        if self.try_sent:
            return self.next_try_at
        if self.tries > 1 and self.index > 0:
            return float("-inf")  # in a recovery, the car must read nothing else before the lone `MODE00`
        # Not from `try_at`, which each frame of the stream puts off.
        began = max(self.began_at, self.try_decided_at) if self.index == 0 else self.last_at
        return began + self.sequence.steps[self.index].after_s + HELD_UP_S

    @property
    def gives_up_at(self) -> float:
        """Return when the stop counts as not shown."""
        return self.began_at + self.timeout_s

    @property
    def gives_way_at(self) -> float:
        """Return when a new command may replace the repeats, or inf if the first frames are not all written.

        A single command does not wait for evidence. It waits for the first frames, until the announced worst case is
        over, or until a report shows that the car is in mode 0 and reads frames.
        """
        if self.repeats:
            return self.began_at
        if not self.sent_once:
            return float("inf")
        return self.report_at if self.report_at > float("-inf") else self.obeys_by

    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if the frames arrive."""
        worst_at = self.worst_at + (0.0 if self.try_sent else max(0.0, now - self.due))
        if self.sequence.is_recovery and self.try_sent:
            # The car may have read all frames as one string, and so misread them. Then only the next try stops it.
            worst_at = max(worst_at, self.next_try_at + AVOIDING_TURN_S)
        return max(worst_at - now, 0.0) + WIRE_S

    def over_at(self, pacing: Pacing, now: float) -> float:
        """Return when a new command may replace the stop, as far as that is known."""
        if self.sent_once or self.repeats:
            return max(self.gives_way_at, now)
        began = self.first_at if self.first_at is not None else max(now, self.due_at(pacing))
        return max(began + self.sequence.length_s + FLIGHT_S, self.worst_at, now)

    def on_step_written(self, now: float) -> bool:
        """Go to the next step. Return True if the written frame was the first of the stop."""
        self.worst_at += max(0.0, now - self.due)  # the frame was late, because our loop was late
        first = self.first_at is None
        if first:
            self.first_at = now
        self.last_at = now
        if isinstance(self.frame, ModeClose):
            self.closed_at = now
        self.index += 1
        self.sent_once = self.sent_once or self.try_sent
        return first

    def on_other_written(self, now: float) -> None:
        """Delay the rest of the stop, so that its frames keep their distance from the command that was sent now."""
        self.other_at = now
        if self.index == 0:  # a try that has not begun
            self.try_at = max(self.try_at, now + FLIGHT_S)

    def begin_try(self, sequence: StopSequence, now: float) -> None:
        """Begin the next try."""
        self.sequence, self.index, self.try_at = sequence, 0, now
        self.try_decided_at = now
