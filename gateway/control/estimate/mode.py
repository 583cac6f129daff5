"""Which mode the car is in: what was asked, what its readings show, and what follows. The car itself never says.

Silence never confirms: the silent modes are at best assumed. What can be told apart and how soon is a table that the
tests walk, tests/vectors/mode_truth.tsv.
"""

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from gateway.control.stops.sequences import REPEAT_S
from gateway.protocol.enums import Mode
from gateway.protocol.events import Sensors
from gateway.protocol.platforms import Profile
from gateway.protocol.timing import FRAME_S, MODE_CLOSE_S, RATE_HZ

CONTRADICTING_FRAMES: Final = 3
"""Frames running with another mode's signature that contradict the asked one
(docs/explanation/how-sure-is-a-mode.md#contradiction)."""
MANUAL_SILENCE_S: Final = 3.0
RUNNING_SILENCE_S: Final = 1.0
"""Silence that contradicts mode 0, and modes 2, 5 and 6, outside known blocks and a running fan."""
MIXED_S: Final = 0.5
"""So soon after a reading of another mode, one may be that mode's, damaged (no checksum); three running are not."""

BLOCKS: Final = 256
"""So many frames explain a silence at most: a car that is made to whistle without a pause reports nothing meanwhile."""


class Verdict(StrEnum):
    """How far the asked mode is to be believed."""

    ASSUMED = "assumed"
    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"


@dataclass(slots=True)
class ModeEstimator:
    """Asked, inferred, verdict, evidence. Times are seconds on one monotonic clock."""

    profile: Profile
    asked: Mode | None = None
    inferred: Mode | None = None
    """The one mode that what was heard, or the silence since, fits; None if it fits several or none."""
    verdict: Verdict = Verdict.ASSUMED
    evidence: str = "nothing heard yet"
    evidence_at: float | None = None
    candidates: tuple[Mode, ...] = ()
    """The modes that it fits; none for a car that should report in every mode, and does not."""
    _asked_at: float = field(default=float("-inf"))
    _settled_at: float = field(default=float("-inf"))
    """From when on the car is in the asked mode, if it has obeyed."""
    _obeyed_at: float = field(default=float("-inf"))
    """The same, if it was in that mode before the last frame."""
    _heard_at: float = field(default=float("-inf"))
    _own_at: float = field(default=float("-inf"))
    """When the last reading came that fits the asked mode, and the last that does not."""
    _other_at: float = field(default=float("-inf"))
    _excused_at: float = field(default=float("-inf"))
    """When silence was last expected: its clock begins anew."""
    _for: int = 0
    _against: int = 0
    """Readings running that fit the asked mode, and that do not."""
    _blocks: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=BLOCKS))
    """When a frame was written that blocks the car, and for how long."""

    @property
    def confirmed(self) -> Mode | None:
        """The asked mode, if it is confirmed."""
        return self.asked if self.verdict is Verdict.CONFIRMED else None

    def ask(self, mode: Mode, *, now: float, block_s: float) -> None:
        """A frame that should bring the car into `mode` was written, which then blocks it for `block_s`."""
        # It is obeyed when the block of the frame before is over, and the turn of the mode that is left: of the slowest
        # one, if that is not known.
        left = self.asked if self.verdict is not Verdict.CONTRADICTED else None
        turn_s = self.profile.mode_turn_s(left or Mode.OBSTACLE_AVOIDANCE)
        self._settled_at = max(self._settled_at, now + turn_s) + block_s
        self._obeyed_at = now + self.profile.mode_turn_s(mode) + block_s
        if mode is self.asked is Mode.MANUAL and self.verdict is Verdict.CONFIRMED:
            return
        self.asked = mode
        self._asked_at = now
        self._for = self._against = 0
        self._other_at = float("-inf")
        self.verdict = Verdict.ASSUMED
        self.evidence = f"{mode} was asked, nothing heard since"
        self.evidence_at = now

    def wrote(self, block_s: float, *, now: float) -> None:
        """Any other frame was written; one that blocks the car delays its readings."""
        if block_s > FRAME_S:
            self._blocks.append((now, block_s))

    def forget(self) -> None:
        """The link was lost: what the car does is not known."""
        self.asked = None
        self.inferred = None
        self.candidates = ()
        self._for = self._against = 0
        self._blocks.clear()
        self.verdict = Verdict.ASSUMED
        self.evidence = "the link was lost"
        self.evidence_at = None

    def heard(self, event: Sensors, *, counts: bool = True) -> None:
        """Take a sensors frame as evidence; one that does not count only ends the silence."""
        at = event.at
        self._heard_at = at
        if not counts:
            return
        candidates = event.candidates
        self._fits(candidates)
        if self.asked is None:
            return
        if self.asked in candidates:
            self._against = 0
            self._own_at = at
            if len(candidates) > 1:
                return
            self._for += 1
            self._settled_at = min(self._settled_at, self._obeyed_at)
            if at >= self._asked_at and (self._for >= CONTRADICTING_FRAMES or at > self._other_at + MIXED_S):
                self._conclude(Verdict.CONFIRMED, f"a reading with the shape of {self.asked}", at)
            return
        self._for = 0
        self._other_at = at
        if at < self._settled_at:
            return  # of the old mode, which was still running
        self._against += 1
        if self._against >= CONTRADICTING_FRAMES:
            shape = " or ".join(candidates)
            self._conclude(Verdict.CONTRADICTED, f"{self._against} readings running with the shape of {shape}", at)

    def silent(self, *, now: float, fan: bool) -> None:
        """Weigh silence: it is expected in some modes, while a block of ours lasts and while the fan runs."""
        if self.asked is None:
            return
        limit = self.silence_limit(fan=fan)
        if limit is None:
            self._expected(self.asked, now)
            return
        silent_s = self.unheard_s(now)
        if silent_s > MANUAL_SILENCE_S:
            self._fits(self._silent_modes)
        if silent_s > limit:
            words = f"silent for {silent_s:.1f} s, {self.asked} reports at least every {limit:g} s"
            if not self._silent_modes:
                words += ", and the car knows no silent mode: it is off, out of reach, or its program has ended"
            self._conclude(Verdict.CONTRADICTED, words, now)
        elif (own_s := self._silence_s(self._own_at, now)) > limit:
            shape = " or ".join(self.candidates)
            words = f"no reading with the shape of {self.asked} for {own_s:.1f} s, the last has that of {shape}"
            self._conclude(Verdict.CONTRADICTED, words, now)

    @property
    def heard_at(self) -> float:
        """Return when the last reading came; -inf if none did."""
        return self._heard_at

    def fade(self, now: float) -> None:
        """Take back a confirmation that is older than the silence that the asked mode allows."""
        if self.verdict is not Verdict.CONFIRMED or self.asked is None:
            return
        limit = MANUAL_SILENCE_S if self.asked is Mode.MANUAL else RUNNING_SILENCE_S
        since_s = now - max(self.evidence_at or self._own_at, self._excused_at)
        blocked_s = sum(block_s for at, block_s in self._blocks if at > now - since_s)
        if self.inferred is None or since_s > limit + blocked_s + MODE_CLOSE_S:
            self._conclude(Verdict.ASSUMED, f"no reading with the shape of {self.asked} for {since_s:.1f} s", now)

    def unheard_s(self, now: float) -> float:
        """Return how long there was no reading, s, what blocks of ours can explain left out; never negative."""
        return max(0.0, self._silence_s(self._heard_at, now))

    def silence_limit(self, *, fan: bool) -> float | None:
        """The longest silence that fits the asked mode, s; None where silence is normal, or nothing was asked."""
        if self.asked is None or self.asked in self.profile.silent_modes or (fan and self.profile.fan_silences):
            return None
        return MANUAL_SILENCE_S if self.asked is Mode.MANUAL else RUNNING_SILENCE_S

    @property
    def _silent_modes(self) -> tuple[Mode, ...]:
        return tuple(mode for mode in Mode if mode in self.profile.possible_modes and mode not in RATE_HZ)

    def _expected(self, asked: Mode, now: float) -> None:
        """Silence is what this mode, or the fan, makes of any car: it confirms nothing, and what is older fades."""
        silent_s = now - max(self._heard_at, self._asked_at)
        if asked not in self.profile.silent_modes:
            self._excused_at = now
            if silent_s > MANUAL_SILENCE_S and self.verdict is not Verdict.CONTRADICTED:
                self._fits(tuple(mode for mode in Mode if mode in self.profile.possible_modes))
                self._conclude(Verdict.ASSUMED, f"silent for {silent_s:.0f} s, as expected while its fan runs", now)
            return
        if now < self._settled_at:
            return
        if self.unheard_s(now) > MANUAL_SILENCE_S:
            self._against = 0
            self._fits(self._silent_modes)
        if self._against == 0 and self.verdict is Verdict.ASSUMED:
            self._conclude(Verdict.ASSUMED, f"silent for {silent_s:.0f} s, as expected", now)

    def _silence_s(self, heard_at: float, now: float) -> float:
        since = max(heard_at, self._settled_at, self._excused_at)
        # What was written before a reading began was obeyed before it; its ranging took 1.0 s at most.
        return now - since - sum(block_s for at, block_s in self._blocks if at > since - REPEAT_S)

    def _fits(self, candidates: tuple[Mode, ...]) -> None:
        self.candidates = candidates
        # One ambiguous reading takes nothing back from a mode that is confirmed: it may be damaged.
        if len(candidates) == 1 or self.verdict is not Verdict.CONFIRMED:
            self.inferred = candidates[0] if len(candidates) == 1 else None

    def _conclude(self, verdict: Verdict, evidence: str, at: float) -> None:
        self.verdict = verdict
        self.evidence = evidence
        self.evidence_at = at
        if verdict is not Verdict.CONFIRMED:
            self.inferred = self.candidates[0] if len(self.candidates) == 1 else None
