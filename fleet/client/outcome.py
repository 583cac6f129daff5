"""What becomes of one command on one car, from its answer and its events. Pure: time is an argument."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Self

QUEUED: Final = "queued"
SENT: Final = "sent"
COMPLETE: Final = "complete"
NO_ANSWER: Final = "no_answer"
_ENDED: Final = frozenset({"superseded", "expired", "failed", "rejected"})

MARGIN_S: Final = 5.0
"""What is waited beyond the time in which the gateway said, or must say, what became of a command.

A stop's worst case ends when the motors are off; the car shows it later, see `SHOW_S`."""
SHOW_S: Final = 12.0  # gateway.control.stops.stopping: time that a car has to show a stop beyond its worst case
GONE_S: Final = 1.0
"""How long a gateway that has gone from the bus may take to be there again: it tries twice a second."""
LATEST_ANSWER_S: Final = 10.0
"""How long an answer may take on an overloaded machine. A gateway that went is known from its token, long before."""
LATE_S: Final = 2.0
"""Of an answer that took longer, what is waited for is counted from when it came, not from when it was asked for."""
PATIENCE_S: Final = 10.0  # gateway.control: the longest that a command waits there for a busy car


class Until(StrEnum):
    """What is waited for."""

    SENT = "sent"
    """The frame was written."""
    STOPPED = "stopped"
    """The car showed the stop, or can show nothing of it."""
    OVER = "over"
    """The drive has ended."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a command on one car."""

    car: str
    ok: bool
    """It was carried out: `sent`, or `complete` where that was waited for."""
    phase: str
    """The last phase heard (`sent, complete, superseded, expired, failed, rejected, queued`), or `no_answer`."""
    reason: str = ""
    """Of the gateway's closed set (`held, wrong_mode, link_down, ...`); empty if there is none."""
    words: str = ""
    """For a person: why, and what to do."""
    worst_case_s: float | None = None
    """A stop's: the longest it could take until the motors are off, as announced. None if no stop was announced."""
    took_s: float = 0.0
    """From asking until this was known, here."""
    basis: str = ""
    """A stop's: `shown` if the car's readings show that it stands, `sent` if they can show nothing."""

    def check(self) -> Self:
        """Itself; raises NotCarriedOut if it was not carried out."""
        if not self.ok:
            raise NotCarriedOut(self)
        return self

    def __str__(self) -> str:
        said = (self.reason or ("" if self.phase == NO_ANSWER else self.phase), self.words)
        return ": ".join((self.car, "carried out" if self.ok else "not carried out", *filter(None, said)))


class NotCarriedOut(Exception):
    """A command was not carried out; `outcome` says on which car, and why."""

    def __init__(self, outcome: Outcome, words: str = "") -> None:
        super().__init__(words or str(outcome))
        self.outcome = outcome


class LeaseLost(NotCarriedOut):
    """The car is another's, or was stopped by another; its words say by whom."""


class Progress:
    """One command on one car; `outcome` is None until it is known what became of it."""

    def __init__(self, car: str, until: Until, asked_at: float, lasts_s: float = 0.0) -> None:
        self.car = car
        self.outcome: Outcome | None = None
        self._until = until
        self._asked_at = asked_at
        self._lasts_s = lasts_s
        self._phase = NO_ANSWER
        self._basis = ""
        self._heard_at = asked_at
        self._counts_from = asked_at
        self._worst_case_s = 0.0
        self._queued = False
        self._sent_told = False
        self._gone_at: float | None = None

    @property
    def _joined(self) -> bool:
        """It only prolongs a drive that its sender holds already: the end is recorded under the earlier id.

        The records tell, in order: an answer alone may be here long before them.
        """
        return self._until is Until.OVER and self._sent_told and not self._queued

    @property
    def deadline(self) -> float:
        """When to give up, on the clock of `asked_at`."""
        if self._gone_at is not None:
            return self._gone_at + GONE_S
        if not self.heard:
            return self._asked_at + LATEST_ANSWER_S + MARGIN_S
        if self._joined:
            return self._counts_from + self._lasts_s
        wait_s = {Until.SENT: PATIENCE_S, Until.STOPPED: self._worst_case_s + SHOW_S, Until.OVER: self._lasts_s}[
            self._until
        ]
        return self._counts_from + wait_s + MARGIN_S

    @property
    def heard(self) -> bool:
        """Whether the car's gateway said anything about the command."""
        return self._phase != NO_ANSWER

    def answered(self, status: str, reason: str, words: str, worst_case_s: float, at: float) -> None:
        """Take the answer to the query; a record of the same command may have overtaken it."""
        self._worst_case_s = max(self._worst_case_s, worst_case_s)
        if self.outcome is not None:
            self.outcome = replace(self.outcome, worst_case_s=self._worst_case_s or None)
        self._note(status, reason, words, at)
        # Nothing had to be stopped, so nothing will be complete: `sent` without a worst case is the last word.
        if status == SENT and self._until is Until.STOPPED and worst_case_s == 0:
            self._end(SENT, reason, words, at, ok=True)

    def event(self, phase: str, reason: str, words: str, worst_case_s: float, at: float, basis: str = "") -> None:
        """Take one record of `event/command`. Only the last record of a stop has a basis."""
        self._sent_told = self._sent_told or phase == SENT
        self._worst_case_s = max(self._worst_case_s, worst_case_s)
        self._basis = basis
        if basis and phase == SENT:
            self._heard_at = at
            self._end(SENT, reason, words, at, ok=True)
        self._note(phase, reason, words, at)

    def missing(self, present: Sequence[str], at: float) -> None:
        """The car has no token."""
        there = f"there are: {', '.join(present)}" if present else "there is none"
        words = f"no car {self.car} on the bus, so whether it moves is not known; {there}"
        self._end(NO_ANSWER, "", words, at, ok=False)

    def silent(self, words: str, at: float) -> None:
        """Its query is over; a car that has not said anything did not answer."""
        if not self.heard:
            self._end(NO_ANSWER, "", words, at, ok=False)

    def unanswered(self, at: float) -> None:
        """Its query was waited for in vain; a car of which something was heard is waited for as long as any other."""
        there = (
            f"is on the bus (slow or hanging), so whether {self.car} does it is not known"
            if self._gone_at is None
            else f"is not on the bus, so whether {self.car} moves is not known"
        )
        self.silent(f"no answer after {at - self._asked_at:.0f} s; its gateway {there}", at)

    def token(self, at: float, *, alive: bool) -> None:
        """Its gateway's token came back, or went: the gateway was killed, or its link or the hub went."""
        if alive:
            self._gone_at = None
        elif self._gone_at is None:
            self._gone_at = at

    def give_up(self, at: float) -> None:
        """The deadline is over."""
        if self._gone_at is not None:
            words = (
                f"its gateway went away, so whether {self.car} moves is not known and nothing stops it: "
                "look; a gateway that is started for it stops it first (fleet up, gateway run)"
            )
            self._end(self._phase, "", words, at, ok=False)
            return
        if self._joined:
            self._end(SENT, "", "it prolonged a drive", at, ok=True)
            return
        words = (
            f"not known what became of it after {at - self._asked_at:.1f} s: "
            f"last heard was {self._phase!r}, {at - self._heard_at:.1f} s ago"
        )
        self._end(self._phase, "", words, at, ok=False)

    def _note(self, phase: str, reason: str, words: str, at: float) -> None:
        if not self.heard and at - self._asked_at > LATE_S:
            self._counts_from = at
        self._heard_at = at
        self._queued = self._queued or phase == QUEUED
        if self._phase not in (SENT, COMPLETE) or phase not in ("asked", QUEUED):
            self._phase = phase
        if phase in _ENDED:
            self._end(phase, reason, words, at, ok=False)
        elif phase == COMPLETE or (phase == SENT and self._until is Until.SENT):
            self._end(phase, reason, words, at, ok=True)

    def _end(self, phase: str, reason: str, words: str, at: float, *, ok: bool) -> None:
        if self.outcome is None:
            took_s = at - self._asked_at
            self.outcome = Outcome(self.car, ok, phase, reason, words, self._worst_case_s or None, took_s, self._basis)
