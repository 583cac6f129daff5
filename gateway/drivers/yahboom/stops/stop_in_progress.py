"""Chooses the stop for the state of a car (`StopContext`), computes its worst case, and tracks a stop in progress.

The worst case is the longest time until the motors are off. `sequences` has the frames.
"""

from typing import Final

from msgspec import Struct, field

from gateway.control.command_log import Pending
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.pacing import FLIGHT_S, Gate, Pacing
from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, ModeClose
from gateway.drivers.yahboom.protocol.modes import MODES
from gateway.drivers.yahboom.protocol.platforms import Profile, StopStyle
from gateway.drivers.yahboom.protocol.timing import FRAME_S, RECOVERY_SILENCE_S, REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stops import cases, sequences
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.drivers.yahboom.stops.sequences import StopSequence
from schemas.limits import MAX_EVIDENCE_TIMEOUT_S
from schemas.words import FrameOrigin, Mode, Platform

WIRE_S: Final = 0.02  # docs/reference/protocol.md#stops: 20 ms of wire for a frame of 19 bytes at 960 B/s
RECOVERY_WORST_S: Final = 7.3  # docs/reference/protocol.md#stops: in theory the maximum, except in obstacle avoidance
_AVOIDING_S: Final = MODES[Mode.OBSTACLE_AVOIDANCE].turn_s
"""Longest turn of obstacle avoidance. A car in an unknown state may be in this mode, whose turns are the longest."""
EVIDENCE_TIMEOUT_S: Final = 12.0
"""Timeout for the evidence of a stop, in addition to its announced worst case. After that the command fails."""
EVIDENCE_INTERVALS: Final = 5
"""Minimum of the timeout for the evidence, as a number of block gaps (intervals that the block of `MODE00` has made
longer): three that may be needed (because one may be in doubt), one for the report before them, and one for the silence
after them. The maximum of the timeout is `MAX_EVIDENCE_TIMEOUT_S`."""
MAX_ANNOUNCED_WORST_S: Final = 5.0
"""Maximum of the worst case that is added to the timeout for the evidence, so that nobody waits longer than 17 s for an
answer, or 23 s with the slowest car."""
# The silence between two tries is longer than any block outside obstacle avoidance, so the car reads the next frame
# alone. The silence becomes 6.5 s at most, so the car reads at least one of two tries within 15 s after the end of a
# fault.
RETRY_S: Final = (RECOVERY_SILENCE_S, 4.5, 5.5, 6.5)
"""Intervals from `MODE00` to the next try, by the number of tries."""
SLOWEST_S: Final = 3.0
"""Interval of the slowest car. It is used until the interval of this car is known."""
REPORT_MARGIN_S: Final = 0.1
"""Margin of the wait for a report after the last frame of a try."""
HELD_UP_S: Final = REPEAT_INTERVAL_S
"""Maximum time for which a stream of actions holds up the next frame of a stop that is being repeated."""
IN_TIME_S: Final = 0.2
"""Minimum time between writing a frame and the end of a block, so that the frame arrives before the end on any link."""


def style_of(profile: Profile, *, doubted: bool, open_mode: bool) -> StopStyle:
    """Return the kind of stop for a car.

    With `doubted`, its readings contradict its platform. With `open_mode`, they show a mode other than 0. A named frame
    ends the program of some cars (docs/reference/protocol.md#programs-that-people-have). So it is sent only if the
    platform or the readings of the car show that the car understands it.
    """
    if profile.stop_style is StopStyle.GENERAL:
        return StopStyle.BOTH if open_mode else StopStyle.GENERAL
    return StopStyle.BOTH if doubted else profile.stop_style


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


class StopContext(Struct, frozen=True):
    """The state of the car that decides which stop it needs."""

    profile: Profile
    known: bool
    """True if recovery is complete and no write has failed since."""
    mode: Mode | None
    """The last commanded mode."""
    contradicted: bool
    clear: bool
    """True if the car has read all our frames before the first frame of the stop is written."""
    blocked: bool = False
    """True if our last frame is blocking the car in mode 0. The car does not range directly after such a block."""
    doubted: bool = False
    """True if readings contradict the platform, so the car needs a stop that works on any platform."""
    open_mode: bool = False
    """True if readings show a mode other than 0."""
    clearing: ColorLed | None = None
    """The last color, if the car may hold a string that only a color frame clears."""

    @property
    def style(self) -> StopStyle:
        """Return the kind of stop."""
        return style_of(self.profile, doubted=self.doubted, open_mode=self.open_mode)

    @property
    def manual(self) -> bool:
        """Return True if mode 0 was commanded last and is not contradicted."""
        return self.mode is Mode.MANUAL and not self.contradicted

    @property
    def turn_s(self) -> float:
        """Return how many seconds one turn of the mode's loop takes at most. The car reads nothing during a turn.

        If the mode is not known, assume the slowest mode.
        """
        known = self.mode is not None and not self.contradicted
        return self.profile.mode_turn_s(self.mode if known and self.mode is not None else Mode.OBSTACLE_AVOIDANCE)


class StopInProgress(Struct):
    """A stop in progress: the frames of its current try, and the commands that end with it. Times: s, monotonic.

    A stop ends on evidence (see evidence.py). After its last frame it waits for a report, then tries again.
    """

    sequence: StopSequence
    why: FrameOrigin
    began_at: float
    try_at: float
    """When the current try began."""
    commands: list[Pending] = field(default_factory=list)
    index: int = 0
    first_at: float | None = None
    """When the first frame of the stop was written."""
    last_at: float = float("-inf")
    """When the last frame of the stop was written."""
    other_at: float = float("-inf")
    """When the last frame of another command was written during the stop."""
    closed_at: float = float("-inf")
    """When the newest `MODE00` was written."""
    tries: int = 1
    worst_at: float = float("-inf")
    """The time by which the motors are off, if all steps are in time and all frames arrive."""
    timeout_s: float = EVIDENCE_TIMEOUT_S
    """Timeout for the evidence, from the arrival of each command."""
    report_wait_s: float = 0.0
    """Minimum wait for a report after the last frame of a try, by the function of this name."""
    due: float = float("inf")
    """When the next step is due, by the last call of `due_at`."""
    report_at: float = float("-inf")
    """Arrival of the last report of mode 0 that the car sent after the newest `MODE00`."""
    no_echo_at: float = float("-inf")
    """Arrival of the last report without an echo that the car sent after the newest `MODE00`. A single one may be
    corrupted, so two are needed."""
    without_echo: int = 0
    """Number of reports without an echo since the stop began."""
    probes: int = 0
    sent_all: bool = False
    """True if all frames of the first try are written, or a report has arrived after its `MODE00`."""
    overdue: bool = False
    """True if the car did not show the stop in time. The gateway continues to send it."""
    mode_command: Pending | None = None
    """The mode command for which this stop is sent first."""
    repeats: bool = False
    """True if this stop repeats one whose first frames are written already. Then a command may replace it at once."""
    at_rest: bool = False
    """True if the car had shown that it stands still before it fell silent. Then it gets only general stops: unlike a
    named frame, a general stop that loses bytes cannot start the motors."""
    case: StopCase = cases.MANUAL
    """The case of the stop: it decides when the stop may end if the car does not show it."""

    @property
    def frames_sent(self) -> bool:
        """Return True if the last frame of this try is written."""
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
        if self.frames_sent:
            return self.next_try_at
        if self.tries > 1 and self.index > 0:
            return float("-inf")  # in a recovery, the car must read nothing else before the lone `MODE00`
        began = self.try_at if self.index == 0 else self.last_at
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
        if not self.sent_all:
            return float("inf")
        return self.report_at if self.report_at > float("-inf") else self.obeys_by

    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if the frames arrive."""
        worst_at = self.worst_at + (0.0 if self.frames_sent else max(0.0, now - self.due))
        if self.sequence.is_recovery and self.frames_sent:
            # The car may have read all frames as one string, and so misread them. Then only the next try stops it.
            worst_at = max(worst_at, self.next_try_at + _AVOIDING_S)
        return max(worst_at - now, 0.0) + WIRE_S

    def over_at(self, pacing: Pacing, now: float) -> float:
        """Return when a new command may replace the stop, as far as that is known."""
        if self.sent_all or self.repeats:
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
        self.sent_all = self.sent_all or self.frames_sent
        return first

    def on_other_written(self, now: float) -> None:
        """Delay the rest of the stop, so that its frames keep their distance from the command that was sent now."""
        self.other_at = now
        if self.index == 0:  # a try that has not begun
            self.try_at = max(self.try_at, now + FLIGHT_S)

    def begin_try(self, sequence: StopSequence, now: float) -> None:
        """Begin the next try."""
        self.sequence, self.index, self.try_at = sequence, 0, now


def recovery(context: StopContext) -> StopSequence:
    """Return the stop that brings a car in an unknown state to rest in mode 0."""
    match context.style:
        case StopStyle.GENERAL:
            return sequences.GENERAL
        case StopStyle.BOTH:
            return sequences.BOTH
        case StopStyle.MODE_FRAME | StopStyle.TIMER:
            return sequences.RECOVERY if context.clearing is None else sequences.clearing(context.clearing)


def full(context: StopContext) -> StopSequence:
    """Return the stop that `stop`, `estop` and a shutdown send."""
    style = context.style
    if not context.known or style is StopStyle.GENERAL:
        return recovery(context)
    if style is StopStyle.BOTH:
        return sequences.BOTH_MANUAL if context.manual else sequences.BOTH
    if not context.manual:
        return sequences.FULL_MODE
    if style is StopStyle.TIMER:
        return sequences.GENERAL  # `MODE00` would show nothing, and turn the LED off
    return sequences.FULL if context.clear else sequences.FULL_BEHIND


def soft(context: StopContext) -> StopSequence:
    """Return the stop that ends a drive."""
    if context.style is StopStyle.GENERAL:
        return sequences.GENERAL_SOFT
    if context.known and context.manual and context.style is not StopStyle.BOTH:
        return sequences.SOFT
    return full(context)


def worst_s(sequence: StopSequence, context: StopContext, pacing: Pacing, now: float) -> float:
    """Return the longest time until the motors are off for good, s, for a sequence that begins now."""
    # Add the waits before a frame, the rest of the running block, and the time on the wire
    # (docs/reference/protocol.md#stops). If an unread frame of ours may spoil the first frames, also add the wait until
    # a frame is alone in the buffer.
    flight_s = max(pacing.ready_at(Gate.FLIGHT) - now, 0.0)
    block_s = max(pacing.block_until - now, 0.0)
    ranging_s = FRAME_S if context.blocked else context.profile.mode_turn_s(Mode.MANUAL)
    lost_s = 0.0 if context.clear else REPEAT_INTERVAL_S
    if sequence in (sequences.FULL, sequences.FULL_MODE):
        alone_s = max(pacing.buffer_until - now, 0.0)
        if not context.manual and now + alone_s + IN_TIME_S < pacing.earliest_block_end:
            return block_s + WIRE_S  # the car reads `MODE00` when the mode has opened, before the mode's first turn
        if not context.manual:
            return max(alone_s, block_s) + context.turn_s + WIRE_S
        return max(alone_s + ranging_s, block_s + FRAME_S) + WIRE_S
    if sequence.is_recovery and context.style is StopStyle.TIMER:
        return sequence.steps[1].after_s + FRAME_S + WIRE_S  # nothing blocks this car
    if sequence.is_recovery:
        return RECOVERY_WORST_S + _AVOIDING_S
    if sequence is sequences.BOTH:
        # Even if the first frames merge with a partial frame and open a mode, the second half of the sequence closes
        # it.
        return RECOVERY_SILENCE_S + _AVOIDING_S + WIRE_S
    if sequence is sequences.GENERAL and not context.known and context.profile.kind is not Platform.RASPBERRY_PI:
        lost_s = REPEAT_INTERVAL_S  # the first two frames are lost if the car has half a frame in its buffer
        return flight_s + FRAME_S + lost_s + ranging_s + WIRE_S
    begins_with_one = sequence in (sequences.SOFT, sequences.FULL_BEHIND) or (context.clear and context.known)
    second_s = 0.0 if begins_with_one else FRAME_S  # of two frames, the car may read only the second
    if context.clear:
        return max(flight_s + second_s + ranging_s, block_s + FRAME_S) + WIRE_S
    return max(flight_s + second_s + lost_s, block_s) + ranging_s + WIRE_S
