"""Which stop, how long it takes at worst, and one that is being carried out, step by step. The frames: recipes.py."""

from dataclasses import dataclass, field
from typing import Final

from gateway.control.command_log import Pending
from gateway.control.events import FrameOrigin
from gateway.control.pacing import Pacing
from gateway.control.stops import sequences
from gateway.control.stops.evidence import StopCase
from gateway.control.stops.sequences import Gate, StopSequence
from gateway.protocol.enums import Mode
from gateway.protocol.frames import Frame, ModeClose
from gateway.protocol.platforms import Profile, StopStyle
from gateway.protocol.timing import FRAME_S, MODE_TURN_S

WIRE_S: Final = 0.02  # docs/reference/protocol.md#stops: 20 ms of wire for a frame of 19 bytes at 960 B/s
RECOVERY_WORST_S: Final = 7.3  # docs/reference/protocol.md#stops: in theory never longer outside avoidance
_AVOIDING_S: Final = MODE_TURN_S[Mode.OBSTACLE_AVOIDANCE]
"""Of a car in an unknown state it is not known that it is not avoiding obstacles."""
SHOW_S: Final = 12.0
"""Time that a car has to show a stop, beyond the announced worst case, before a command counts as failed."""
LONGEST_WORST_S: Final = 5.0
"""Maximum of the worst case that counts for that: nobody waits longer than 17 s for an answer."""
SHOWN_S: Final = 2.0
"""Usual time from the last frame to the evidence."""
RETRY_S: Final = (sequences.SILENCE_S, 4.5, 5.5, 6.5)
"""Interval from `MODE00` to the next try, by tries. Silence makes the next frame certain: it is longer than any block
outside avoidance. It grows to 6.5 s: of two tries on a link that is whole again, one is certain within 15 s."""
REPORTED_S: Final = 4.1
"""Minimum wait after the last frame of a try. Without an echo the car ranges for 1.0 s before it reads the frame, is
blocked for 1.0 s, reports after 0.9 s, and ranges for 1.0 s more before that."""
IN_TIME_S: Final = 0.2
"""A frame written so long before a block can end lies in the buffer when it does, whatever the link's own delay."""


def style_of(profile: Profile, *, doubted: bool) -> StopStyle:
    """Return which kind of stop a car takes; `doubted`: its bytes speak against its platform."""
    return StopStyle.UNKNOWN if doubted else profile.stop_style


@dataclass(frozen=True, slots=True)
class StopContext:
    """What the choice of a stop looks at."""

    profile: Profile
    known: bool
    """Recovery is complete and no write has failed since."""
    mode: Mode | None
    """The mode that was asked last."""
    contradicted: bool
    clear: bool
    """No frame of ours can lie unread in the car's buffer when the first frame of the stop is written."""
    blocked: bool = False
    """In mode 0 a block of ours runs: the car ranges some time after it, but not at once."""
    doubted: bool = False
    """Its bytes speak against its platform: what stops any platform is what stops it."""

    @property
    def style(self) -> StopStyle:
        """Which kind of stop it takes."""
        return style_of(self.profile, doubted=self.doubted)

    @property
    def manual(self) -> bool:
        """Mode 0 is the last asked and not contradicted."""
        return self.mode is Mode.MANUAL and not self.contradicted

    @property
    def turn_s(self) -> float:
        """The longest that a turn of the mode's own loop is deaf; of the slowest mode, if it is not known which."""
        known = self.mode is not None and not self.contradicted
        return self.profile.mode_turn_s(self.mode if known and self.mode is not None else Mode.OBSTACLE_AVOIDANCE)


@dataclass(slots=True)
class StopInProgress:
    """A stop under way: the frames of its present try, and the commands that end with it. Times: s, monotonic.

    A stop ends on evidence (see `stop_evidence`), so after its last frame it waits, and tries again.
    """

    recipe: StopSequence
    why: FrameOrigin
    began_at: float
    try_at: float
    """When the present try began."""
    commands: list[Pending] = field(default_factory=list)
    index: int = 0
    first_at: float | None = None
    """When the first frame of the stop was written."""
    last_at: float = float("-inf")
    closed_at: float = float("-inf")
    """When its newest `MODE00` was written."""
    tries: int = 1
    worst_at: float = float("-inf")
    """When the motors are off at the latest, if no step is late and all frames arrive."""
    patience_s: float = SHOW_S
    """A command whose stop is not shown for so long has failed."""
    due: float = float("inf")
    """When the next step is due, as last asked."""
    report_at: float = float("-inf")
    """When the last report of mode 0 came that was sent after its newest `MODE00`."""
    no_echo_at: float = float("-inf")
    """The same, of one without an echo. One alone may be damaged, so two count."""
    without_echo: int = 0
    """Such reports since the stop began."""
    probes: int = 0
    overdue: bool = False
    """Nothing showed it in time. The stop goes on."""
    at_rest: bool = False
    """The car had shown that it stands before it fell silent. It is sent general stops only: unlike a named frame, one
    that loses bytes on the way can set nothing going."""
    case: StopCase = StopCase.MANUAL
    """What it rests on if it is not shown."""

    @property
    def frames_sent(self) -> bool:
        """Return True if the last frame of this try is written."""
        return self.index >= len(self.recipe.steps)

    @property
    def frame(self) -> Frame:
        """Return the frame of the next step."""
        return self.recipe.steps[self.index].frame

    def due_at(self, pacing: Pacing) -> float:
        """Return when the next step is due."""
        step = self.recipe.steps[self.index]
        due = self.try_at if self.index == 0 else self.last_at + step.after_s
        self.due = max(due, pacing.ready_at(step.gate))
        return self.due

    @property
    def obeyed_at(self) -> float:
        """Return when the car has obeyed at the latest, if the frames arrived."""
        return max(self.last_at, self.worst_at)

    @property
    def next_try_at(self) -> float:
        """Return when the stop is sent again if nothing shows it before."""
        after = self.closed_at if self.closed_at > float("-inf") else self.last_at
        return max(self.last_at + REPORTED_S, after + RETRY_S[min(self.tries, len(RETRY_S)) - 1])

    @property
    def gives_up_at(self) -> float:
        """Return when what nothing has shown counts as not shown."""
        return self.began_at + self.patience_s

    def worst_s(self, now: float) -> float:
        """Return how long it takes from now on, at worst, if the frames arrive."""
        worst_at = self.worst_at + (0.0 if self.frames_sent else max(0.0, now - self.due))
        if self.recipe is sequences.RECOVERY and self.frames_sent:
            # Should all its frames have been read at the wrong place, in one string, it tries again.
            worst_at = max(worst_at, self.next_try_at + _AVOIDING_S)
        return max(worst_at - now, 0.0) + WIRE_S

    def over_at(self, pacing: Pacing, now: float) -> float:
        """Return when it will be over, as far as that is known."""
        began = self.first_at if self.first_at is not None else max(now, self.due_at(pacing))
        shown_s = 0.0 if self.case is StopCase.SOFT else SHOWN_S
        return max(began + self.recipe.length_s, self.worst_at, now) + shown_s

    def stepped(self, now: float) -> bool:
        """Note that a step's frame was written. Return True if it was the stop's first."""
        self.worst_at += max(0.0, now - self.due)  # a loop that slept
        first = self.first_at is None
        if first:
            self.first_at = now
        self.last_at = now
        if isinstance(self.frame, ModeClose):
            self.closed_at = now
        self.index += 1
        return first

    def again(self, recipe: StopSequence, now: float) -> None:
        """Begin the next try."""
        self.recipe, self.index, self.try_at = recipe, 0, now


def recovery(situation: StopContext) -> StopSequence:
    """What brings a car of unknown state to rest in mode 0."""
    match situation.style:
        case StopStyle.RASPBERRY_PI:
            return sequences.PI
        case StopStyle.UNKNOWN:
            return sequences.UNKNOWN
        case StopStyle.MODE_FRAME:
            return sequences.RECOVERY


def full(situation: StopContext) -> StopSequence:
    """What `stop`, `estop` and a shutdown send."""
    style = situation.style
    if not situation.known or style is StopStyle.RASPBERRY_PI:
        return recovery(situation)
    if style is StopStyle.UNKNOWN:
        return sequences.UNKNOWN_MANUAL if situation.manual else sequences.UNKNOWN
    return sequences.FULL_BEHIND if situation.manual and not situation.clear else sequences.FULL


def soft(situation: StopContext) -> StopSequence:
    """What release and expiry send."""
    if situation.style is StopStyle.RASPBERRY_PI:
        return sequences.PI_SOFT
    if situation.known and situation.manual and situation.style is StopStyle.MODE_FRAME:
        return sequences.SOFT
    return full(situation)


def worst_s(recipe: StopSequence, situation: StopContext, pacing: Pacing, now: float) -> float:
    """How long a recipe that begins now takes at worst until the motors are off for good.

    See docs/reference/protocol.md#stops.
    What it waits for + the rest of the block it meets + the wire; and where its first frames may be lost, because a
    frame of ours lies unread in the car's buffer, the wait until the one that is alone there.
    """
    flight_s = max(pacing.ready_at(Gate.FLIGHT) - now, 0.0)
    block_s = max(pacing.block_until - now, 0.0)
    ranging_s = FRAME_S if situation.blocked else situation.profile.mode_turn_s(Mode.MANUAL)
    lost_s = 0.0 if situation.clear else sequences.REPEAT_S
    if recipe is sequences.FULL:
        alone_s = max(pacing.buffer_until - now, 0.0)
        if not situation.manual and now + alone_s + IN_TIME_S < pacing.block_from:
            return block_s + WIRE_S  # it lies in the buffer when the opening ends, and is obeyed before the first turn
        if not situation.manual:
            return max(alone_s, block_s) + situation.turn_s + WIRE_S
        return max(alone_s + ranging_s, block_s + FRAME_S) + WIRE_S
    if recipe is sequences.RECOVERY:
        return RECOVERY_WORST_S + _AVOIDING_S
    if recipe is sequences.UNKNOWN:
        # No string that its frames make, with half of any frame before them, opens a mode that its second part misses.
        return sequences.SILENCE_S + _AVOIDING_S + WIRE_S
    one = recipe in (sequences.SOFT, sequences.FULL_BEHIND) or (situation.clear and situation.known)
    twice_s = 0.0 if one else FRAME_S  # the second of two general stops: the first may end half a frame, or be lost
    if situation.clear:
        return max(flight_s + twice_s + ranging_s, block_s + FRAME_S) + WIRE_S
    return max(flight_s + twice_s + lost_s, block_s) + ranging_s + WIRE_S
