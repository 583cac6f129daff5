"""A stop that is being carried out: one recipe at a time, step by step. What is sent is in recipes.py."""

from dataclasses import dataclass, field

from gateway.control import recipes
from gateway.control.ledger import Pending
from gateway.control.outbox import Pacing
from gateway.control.recipes import Recipe
from gateway.control.records import Why
from gateway.protocol.encode import Frame
from gateway.protocol.profile import Profile, StopStyle


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
    turn_s: float = 0.0
    """How long the car may be in a turn of its mode, deaf, before it reads the first frame."""

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
        if self.first_at is not None and step.from_start_s:
            due = max(due, self.first_at + step.from_start_s)
        return max(due, pacing.ready_at(step.gate))

    @property
    def obeyed_at(self) -> float:
        """When the car has obeyed at the latest, if no reading says so earlier and none has to."""
        return max(self.last_at, self.began_at if self.first_at is None else self.first_at + self.turn_s)

    def wake_at(self, pacing: Pacing) -> float:
        """When there is something to do: the next step, or the end of the patience."""
        if not self.frames_sent:
            return self.due_at(pacing)
        return self.last_at + recipes.CONFIRM_S if self.recipe.confirmed else self.obeyed_at

    def over_at(self, pacing: Pacing, now: float) -> float:
        """When it will be over, as far as that is known."""
        began = self.first_at if self.first_at is not None else max(now, self.due_at(pacing))
        return began + max(self.recipe.length_s, self.turn_s)

    def stepped(self, now: float) -> bool:
        """A step's frame was written; True if it was the first."""
        first = self.first_at is None
        if first:
            self.first_at = now
        self.last_at = now
        self.index += 1
        return first

    def again(self, now: float) -> "Running":
        """The short recovery that follows when no reading confirmed this one."""
        return Running(recipes.RETRY, self.why, now, self.commands, first_at=now, last_at=now, retries=self.retries + 1)


def recovery(profile: Profile) -> Recipe:
    """What brings a car of unknown state to rest in mode 0."""
    match profile.stop_style:
        case StopStyle.RASPBERRY_PI:
            return recipes.PI
        case StopStyle.UNKNOWN:
            return recipes.UNKNOWN
        case StopStyle.MODE_FRAME:
            return recipes.RECOVERY


def full(profile: Profile, *, known: bool) -> Recipe:
    """What `stop`, `estop` and a shutdown send. `known`: recovery is complete and no write has failed since."""
    if known and profile.stop_style is StopStyle.MODE_FRAME:
        return recipes.FULL
    return recovery(profile)


def soft(profile: Profile, *, known: bool, manual: bool) -> Recipe:
    """What release and expiry send. `manual`: mode 0 is the last asked and not contradicted."""
    if profile.stop_style is StopStyle.RASPBERRY_PI:
        return recipes.PI_SOFT
    if known and manual and profile.stop_style is StopStyle.MODE_FRAME:
        return recipes.SOFT
    return full(profile, known=known)
