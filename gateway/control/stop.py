"""Which stop, how long it takes at worst, and one that is being carried out, step by step. The frames: recipes.py."""

from dataclasses import dataclass, field
from typing import Final

from gateway.control import recipes
from gateway.control.ledger import Pending
from gateway.control.outbox import Pacing
from gateway.control.recipes import Gate, Recipe
from gateway.control.records import Why
from gateway.protocol.encode import Frame
from gateway.protocol.profile import Profile, StopStyle
from gateway.protocol.timing import FRAME_S, MODE_TURN_S
from gateway.protocol.values import Mode

WIRE_S: Final = 0.02  # protocol.md: 20 ms of wire for a frame of 19 bytes at 960 B/s
RECOVERY_WORST_S: Final = 7.3  # protocol.md, "recovery": theory, never over 7.3 s outside avoidance
_AVOIDING_S: Final = MODE_TURN_S[Mode.OBSTACLE_AVOIDANCE]
"""Of a car in an unknown state it is not known that it is not avoiding obstacles."""
IN_TIME_S: Final = 0.2
"""A frame written so long before a block can end lies in the buffer when it does, whatever the link's own delay."""


@dataclass(frozen=True, slots=True)
class Situation:
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
        return StopStyle.UNKNOWN if self.doubted else self.profile.stop_style

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
class Running:
    """A recipe under way, and the commands that are over with it. Times: s, monotonic."""

    recipe: Recipe
    why: Why
    began_at: float
    commands: list[Pending] = field(default_factory=list)
    index: int = 0
    first_at: float | None = None
    last_at: float = float("-inf")
    retries: int = 0
    disobeyed: bool = False
    """What was heard meanwhile shows that one of its frames was lost."""
    worst_at: float = float("-inf")
    """When the motors are off at the latest, if no step is late."""
    due: float = float("inf")
    """When the next step is due, as last asked."""

    @property
    def frames_sent(self) -> bool:
        """Its last frame is written."""
        return self.index >= len(self.recipe.steps)

    @property
    def frame(self) -> Frame:
        """The frame of the next step."""
        return self.recipe.steps[self.index].frame

    def due_at(self, pacing: Pacing) -> float:
        """When the next step is due."""
        step = self.recipe.steps[self.index]
        due = self.began_at if self.first_at is None else self.last_at + step.after_s
        self.due = max(due, pacing.ready_at(step.gate))
        return self.due

    @property
    def obeyed_at(self) -> float:
        """When the car has obeyed at the latest, if no reading says so earlier and none has to."""
        return max(self.last_at, self.worst_at)

    def worst_s(self, now: float) -> float:
        """How long it takes from now on, at worst."""
        worst_at = self.worst_at + (0.0 if self.frames_sent else max(0.0, now - self.due))
        if self.recipe in (recipes.RECOVERY, recipes.RETRY) and self.frames_sent:
            # Should all its frames have been read at the wrong place, in one string, it tries again.
            worst_at = max(worst_at, self.last_at + recipes.CONFIRM_S + _AVOIDING_S)
        return max(worst_at - now, 0.0) + WIRE_S

    def wake_at(self, pacing: Pacing) -> float:
        """When there is something to do: the next step, or the end of the patience."""
        if not self.frames_sent:
            return self.due_at(pacing)
        return self.last_at + recipes.CONFIRM_S if self.recipe.confirmed else self.obeyed_at

    def over_at(self, pacing: Pacing, now: float) -> float:
        """When it will be over, as far as that is known."""
        began = self.first_at if self.first_at is not None else max(now, self.due_at(pacing))
        return (
            began + self.recipe.length_s if self.recipe.confirmed else max(began + self.recipe.length_s, self.worst_at)
        )

    def stepped(self, now: float) -> bool:
        """A step's frame was written; True if it was the first."""
        self.worst_at += max(0.0, now - self.due)  # a loop that slept
        first = self.first_at is None
        if first:
            self.first_at = now
        self.last_at = now
        self.index += 1
        return first

    def again(self, now: float) -> "Running":
        """The short recovery that follows when no reading confirmed this one."""
        return Running(
            recipes.RETRY,
            self.why,
            now,
            self.commands,
            first_at=now,
            last_at=now,
            retries=self.retries + 1,
            worst_at=now + _AVOIDING_S,
        )


def recovery(situation: Situation) -> Recipe:
    """What brings a car of unknown state to rest in mode 0."""
    match situation.style:
        case StopStyle.RASPBERRY_PI:
            return recipes.PI
        case StopStyle.UNKNOWN:
            return recipes.UNKNOWN
        case StopStyle.MODE_FRAME:
            return recipes.RECOVERY


def full(situation: Situation) -> Recipe:
    """What `stop`, `estop` and a shutdown send."""
    style = situation.style
    if not situation.known or style is StopStyle.RASPBERRY_PI:
        return recovery(situation)
    if style is StopStyle.UNKNOWN:
        return recipes.UNKNOWN_MANUAL if situation.manual else recipes.UNKNOWN
    return recipes.FULL_BEHIND if situation.manual and not situation.clear else recipes.FULL


def soft(situation: Situation) -> Recipe:
    """What release and expiry send."""
    if situation.style is StopStyle.RASPBERRY_PI:
        return recipes.PI_SOFT
    if situation.known and situation.manual and situation.style is StopStyle.MODE_FRAME:
        return recipes.SOFT
    return full(situation)


def worst_s(recipe: Recipe, situation: Situation, pacing: Pacing, now: float) -> float:
    """How long a recipe that begins now takes at worst until the motors are off for good (protocol.md, stopping).

    What it waits for + the rest of the block it meets + the wire; and where its first frames may be lost, because a
    frame of ours lies unread in the car's buffer, the wait until the one that is alone there.
    """
    flight_s = max(pacing.ready_at(Gate.FLIGHT) - now, 0.0)
    block_s = max(pacing.block_until - now, 0.0)
    ranging_s = FRAME_S if situation.blocked else situation.profile.mode_turn_s(Mode.MANUAL)
    lost_s = 0.0 if situation.clear else recipes.REPEAT_S
    if recipe is recipes.FULL:
        alone_s = max(pacing.buffer_until - now, 0.0)
        if not situation.manual and now + alone_s + IN_TIME_S < pacing.block_from:
            return block_s + WIRE_S  # it lies in the buffer when the opening ends, and is obeyed before the first turn
        if not situation.manual:
            return max(alone_s, block_s) + situation.turn_s + WIRE_S
        return max(alone_s + ranging_s, block_s + FRAME_S) + WIRE_S
    if recipe is recipes.RECOVERY:
        return RECOVERY_WORST_S + _AVOIDING_S
    if recipe is recipes.UNKNOWN:
        # No string that its frames make, with half of any frame before them, opens a mode that its second part misses.
        return recipes.SILENCE_S + _AVOIDING_S + WIRE_S
    one = recipe in (recipes.SOFT, recipes.FULL_BEHIND) or (situation.clear and situation.known)
    twice_s = 0.0 if one else FRAME_S  # the second of two general stops: the first may end half a frame, or be lost
    if situation.clear:
        return max(flight_s + twice_s + ranging_s, block_s + FRAME_S) + WIRE_S
    return max(flight_s + twice_s + lost_s, block_s) + ranging_s + WIRE_S
