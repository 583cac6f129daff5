"""Which mode the car is in: what was asked, what its readings show, and what follows. The car itself never says.

Silence never confirms: the silent modes are at best assumed.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from gateway.protocol.profile import Profile
from gateway.protocol.readings import Sensors
from gateway.protocol.values import Mode

CONTRADICTING_FRAMES: Final = 3
"""Frames running with another mode's signature that contradict the asked one (design.md, "Truth about a car")."""
MANUAL_SILENCE_S: Final = 3.0
RUNNING_SILENCE_S: Final = 1.0
"""Silence that contradicts mode 0, and modes 2, 5 and 6, outside known blocks and a running fan."""


class Verdict(StrEnum):
    """How far the asked mode is to be believed."""

    ASSUMED = "assumed"
    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"


@dataclass(slots=True)
class ModeTruth:
    """Asked, inferred, verdict, evidence. Times are seconds on one monotonic clock."""

    profile: Profile
    asked: Mode | None = None
    inferred: Mode | None = None
    verdict: Verdict = Verdict.ASSUMED
    evidence: str = "nothing heard yet"
    evidence_at: float | None = None
    candidates: tuple[Mode, ...] = ()
    _asked_at: float = field(default=float("-inf"))
    _settled_at: float = field(default=float("-inf"))
    _heard_at: float = field(default=float("-inf"))
    _against: int = 0

    def ask(self, mode: Mode, *, now: float, block_s: float) -> None:
        """A frame that should bring the car into `mode` was written; readings are of before until its block is over."""
        if mode == self.asked and mode is Mode.MANUAL and self.verdict is Verdict.CONFIRMED:
            self._settled_at = max(self._settled_at, now + block_s)
            return
        self.asked = mode
        self._asked_at = now
        self._settled_at = now + block_s
        self._against = 0
        self.verdict = Verdict.ASSUMED
        self.evidence = f"{mode} was asked, nothing heard since"
        self.evidence_at = now

    def forget(self) -> None:
        """The link was lost: what the car does is not known."""
        self.asked = None
        self.inferred = None
        self.candidates = ()
        self._against = 0
        self.verdict = Verdict.ASSUMED
        self.evidence = "the link was lost"
        self.evidence_at = None

    def heard(self, event: Sensors) -> None:
        """Take a sensors frame as evidence."""
        now = event.at
        self._heard_at = now
        candidates = event.candidates
        self.candidates = candidates
        if len(candidates) == 1:
            self.inferred = candidates[0]
        if self.asked is None:
            return
        shape = " or ".join(candidates)
        if self.asked in candidates:
            self._against = 0
            # A reading of the old mode may still be under way while the new one opens.
            if now >= self._asked_at and len(candidates) == 1:
                self.verdict = Verdict.CONFIRMED
                self.evidence = f"a reading with the shape of {shape}"
                self.evidence_at = now
            return
        if now < self._settled_at:
            return
        self._against += 1
        if self._against >= CONTRADICTING_FRAMES:
            self.verdict = Verdict.CONTRADICTED
            self.evidence = f"{self._against} readings running with the shape of {shape}"
            self.evidence_at = now

    def silent(self, *, now: float, blocked_until: float, fan: bool) -> None:
        """Weigh silence: it is expected in some modes, while a block of ours lasts and while the fan runs."""
        limit = self.silence_limit(fan=fan)
        if self.asked is None or limit is None:
            if self.asked is not None and self.verdict is Verdict.ASSUMED and self._heard_at < self._settled_at <= now:
                self.evidence = f"silent for {now - max(self._heard_at, self._asked_at):.0f} s, as expected"
                self.evidence_at = now
            return
        silent_s = self.unheard_s(now=now, blocked_until=blocked_until)
        if silent_s > limit:
            self.verdict = Verdict.CONTRADICTED
            self.evidence = f"silent for {silent_s:.1f} s, {self.asked} reports at least every {limit:g} s"
            self.evidence_at = now

    def unheard_s(self, *, now: float, blocked_until: float) -> float:
        """How long there was no reading, s, known blocks left out."""
        return now - max(self._heard_at, self._settled_at, blocked_until)

    def silence_limit(self, *, fan: bool) -> float | None:
        """The longest silence that fits the asked mode, s; None where silence is normal."""
        if fan or self.asked is None or self.asked in self.profile.silent_modes:
            return None
        return MANUAL_SILENCE_S if self.asked is Mode.MANUAL else RUNNING_SILENCE_S
