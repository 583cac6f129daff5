"""The outcome of one command on one car, from its answer and its events. Pure: time is an argument."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Self

from fleet.client.claims import NOT_STOPPED
from fleet.client.outcome_words import NEXT_STEPS, STOP_VERBS, UNCONFIRMED, describe, with_code
from schemas.limits import MAX_EVIDENCE_TIMEOUT_S, MAX_QUEUE_TIME_S
from schemas.picklable import Picklable
from schemas.suggestion import did_you_mean
from schemas.words import Basis, Phase, Reason

NO_ANSWER: Final = "no_answer"
"""Phase and code of a command that got no answer."""
NO_RESULT: Final = "no_result"
"""Code of a command whose last event is missing."""
_STILL_STOPPED: Final = (Reason.ESTOPPED, Reason.HELD)
"""If a resume completes with one of these reasons, the car is still stopped, so the resume has failed."""
_FAILED_PHASES: Final = frozenset({Phase.SUPERSEDED, Phase.EXPIRED, Phase.FAILED, Phase.REJECTED})

OUTCOME_MARGIN_S: Final = 5.0
"""Time that a command's last event may be late: it is added to the longest time that the command itself can take."""
GATEWAY_RETURN_TIMEOUT_S: Final = 1.0
"""Timeout for a gateway to rejoin the bus. A gateway tries to do so twice a second."""
GATEWAY_RESTART_TIMEOUT_S: Final = 15.0
"""Timeout for a car's new gateway if a supervisor starts one. The supervisor takes 4 s to notice a hang."""
OVERLOAD_ANSWER_TIMEOUT_S: Final = 10.0
"""Timeout for an answer on an overloaded machine. A gateway that has gone is noticed earlier: its token disappears."""
LATE_ANSWER_S: Final = 2.0
"""If an answer takes longer than this, further timeouts count from the answer, not from the request."""


class Until(StrEnum):
    """The event that completes a command."""

    SENT = "sent"
    """The gateway has written the frame."""
    STOPPED = "stopped"
    """The car's readings have shown that it stands, or the gateway has found that no reading can show it."""
    OVER = "over"
    """The drive has ended."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a command on one car."""

    car: str
    ok: bool
    """True if the command was carried out: it was sent to the car, and if it takes time, it is complete."""
    phase: str
    """The last phase (`asked, queued, sent, effect_seen, complete, superseded, expired, failed, rejected`), or
    `no_answer`."""
    reason: str = ""
    """The gateway's reason if it was not carried out (`held, wrong_mode, link_down, ...`), else empty."""
    words: str = ""
    """Text for a person, never empty: what was done, or the cause and what to do."""
    worst_case_s: float | None = None
    """For a stop: the maximum time until the motors are off, as the gateway announced. None for other commands."""
    took_s: float = 0.0
    """Time from the request until the outcome was known."""
    basis: str = ""
    """For a stop: `shown` if the car's readings show that it stands still, `sent` if they cannot.

    For a drive: `sent`, because no reading proves that the car drove.
    """
    effect: str = ""
    """The effect of the command in words: `LED color sent`, `stopped (1.2 s)`, `sent for 3.0 s`, `refused: ...`."""
    next_step: str = ""
    """How to end what the command began, such as an e-stop. Empty if there is nothing to end."""

    @property
    def code(self) -> str:
        """Why the command was not carried out. Empty if it was.

        The gateway's reason if there is one, else `no_answer`, else the phase in which the command failed, else
        `no_result`.
        """
        if self.ok or self.reason:
            return self.reason
        return self.phase if self.phase in (NO_ANSWER, *_FAILED_PHASES) else NO_RESULT

    def check(self) -> Self:
        """Return this outcome. Raises NotCarriedOut if the command was not carried out."""
        if not self.ok:
            raise NotCarriedOut(self)
        return self

    def __str__(self) -> str:
        text = self.effect or self.words or self.phase
        if self.ok and self.basis == Basis.SENT and self.worst_case_s is not None:
            at_most_s = math.ceil(round(self.worst_case_s * 10, 6)) / 10  # a maximum is rounded up
            text += f"; motors off within {at_most_s:.1f} s if the frames arrived"
        if self.next_step:
            text += f". {self.next_step}"
        named = text if text.startswith(f"{self.car} ") else f"{self.car}: {text}"
        return with_code(named, self.code)


class NotCarriedOut(Picklable, Exception):
    """A command was not carried out. `outcome` contains the car and the reason."""

    def __init__(self, outcome: Outcome, words: str = "") -> None:
        super().__init__(with_code(words, outcome.code) if words else str(outcome))
        self.outcome = outcome


class LeaseLost(NotCarriedOut):
    """Another sender has taken or stopped the car. The text names the sender."""


def bus_lost_words(car: str) -> str:
    """Return the text for a stop that reached no gateway because the bus was lost."""
    return f"{NOT_STOPPED}: the fleet's bus does not answer. If {car} moves, go to the car."


class Progress:
    """The progress of one command on one car. `outcome` is None until it is known.

    Whoever asks must get an outcome soon, but must not be told that a command has failed that is only late. So the time
    to give up (`deadline`) depends on what is known of it. Without an answer, it is as long as an overloaded computer
    may take. If the gateway is gone, it is as long as the gateway needs to come back, or a supervisor to start another
    one. With an answer, it is as long as the command itself may take, and a margin.
    """

    def __init__(
        self, car: str, until: Until, asked_at: float, duration_s: float = 0.0, *, verb: str = "", detail: str = ""
    ) -> None:
        self.car = car
        self._verb = verb
        self._detail = detail
        self.outcome: Outcome | None = None
        self._until = until
        self._asked_at = asked_at
        self._duration_s = duration_s
        self._phase = NO_ANSWER
        self._basis = ""
        self._last_event_at = asked_at
        self._timeout_from = asked_at
        """When the time that the command itself may take begins: when it was asked, when a late answer came, or when
        the frame of a drive was sent."""
        self._worst_case_s = 0.0
        self._queued = False
        self.why_waiting = ""
        """Why the command waits for its car, and for how long at most, in the gateway's words. Empty once its frame is
        sent."""
        self._sent_event = False
        """True if the gateway has sent the event `sent`. The answer to the query may say so long before."""
        self._gone_at: float | None = None
        """When the token of the gateway disappeared. None while the gateway is on the bus."""
        self._is_supervised = False
        self._foreign = ""
        """The text about another program that answered."""
        self._why_unanswered = ""
        """Why the last query of a stop ended without an answer."""
        self._bus_lost_until: float | None = None
        """The time to give up, for a stop that had no answer when the bus was lost."""

    @property
    def awaits_gateway(self) -> bool:
        """True while the gateway is gone, and may still come back."""
        return self.outcome is None and self._gone_at is not None

    @property
    def awaits_bus(self) -> bool:
        """True while the bus is gone, and this is a stop that is sent again when it is back."""
        return self.outcome is None and self._bus_lost_until is not None and not self.answered

    @property
    def _extends_drive(self) -> bool:
        """True if the command extends a running drive. An older gateway sends no event when that drive ends.

        A drive that begins is queued before it is sent. An extension is sent without being queued.
        """
        # Wait for the event `sent`: the answer may arrive long before it, and the events come in order.
        return self._until is Until.OVER and self._sent_event and not self._queued

    @property
    def deadline(self) -> float:
        """The time to give up, on the clock of `asked_at`."""
        if self._bus_lost_until is not None and self.awaits_bus:
            return self._bus_lost_until
        if self._gone_at is not None:
            return self._gone_at + (GATEWAY_RESTART_TIMEOUT_S if self._is_supervised else GATEWAY_RETURN_TIMEOUT_S)
        if not self.answered:
            return self._asked_at + OVERLOAD_ANSWER_TIMEOUT_S + OUTCOME_MARGIN_S
        if self._extends_drive:
            return self._timeout_from + self._duration_s + OUTCOME_MARGIN_S
        wait_s = {
            Until.SENT: MAX_QUEUE_TIME_S,
            Until.STOPPED: self._worst_case_s + MAX_EVIDENCE_TIMEOUT_S,
            # The duration counts from the time of the frame. The frame may have to wait for the end of a stop.
            Until.OVER: self._duration_s + (0.0 if self._sent_event else MAX_QUEUE_TIME_S),
        }[self._until]
        return self._timeout_from + wait_s + OUTCOME_MARGIN_S

    @property
    def answered(self) -> bool:
        """True if the car's gateway has sent an answer or event of the command."""
        return self._phase != NO_ANSWER

    def on_answer(self, status: str, reason: str, words: str, worst_case_s: float, at: float) -> None:
        """Handle the answer to the query. An event of the same command may have overtaken the answer."""
        self._worst_case_s = max(self._worst_case_s, worst_case_s)
        if self.outcome is not None:
            self.outcome = replace(self.outcome, worst_case_s=self._worst_case_s or None)
        self._note(status, reason, words, at)
        # If no motors had to be stopped, `sent` without a worst case is final: there will be no `complete`.
        if status == Phase.SENT and self._until is Until.STOPPED and worst_case_s == 0:
            self._end(Phase.SENT, reason, words, at, ok=True)

    def on_event(self, phase: str, reason: str, words: str, worst_case_s: float, at: float, basis: str = "") -> None:
        """Handle one `event/command`. `basis` is set only in the last event of a stop or a drive."""
        if phase == Phase.SENT and self._queued and not self._sent_event and self._until is Until.OVER:
            self._timeout_from = at
        self._sent_event = self._sent_event or phase == Phase.SENT
        self._worst_case_s = max(self._worst_case_s, worst_case_s)
        self._basis = basis
        if basis and phase == Phase.SENT:
            self._last_event_at = at
            self._end(Phase.SENT, reason, words, at, ok=True)
        self._note(phase, reason, words, at)

    def on_missing(self, present: Sequence[str], at: float) -> None:
        """Give up, because the car's gateway is not on the bus (it has no token)."""
        there = f"Connected: {', '.join(present)}." if present else "No car is connected."
        words = f'No car named "{self.car}". {" ".join(filter(None, (did_you_mean(self.car, present), there)))}'
        if self._verb in STOP_VERBS:
            words = f"{NOT_STOPPED}: {words} If it moves, go to the car."
        self._end(NO_ANSWER, "", words, at, ok=False)

    def on_bus_lost(self, at: float, until: float) -> None:
        """Note that the bus was lost before this stop was answered. The stop is sent again until the time `until`."""
        if self.outcome is None and not self.answered:
            self._bus_lost_until = until
            self.on_presence(at, alive=False)

    def on_supervised(self, at: float, *, present: bool) -> None:
        """Note that a supervisor restarts the gateway, so that a gateway that is gone is awaited for longer.

        present: False if the gateway is gone now.
        """
        self._is_supervised = True
        if not present:
            self.on_presence(at, alive=False)

    def on_foreign_answer(self, words: str) -> None:
        """Note that another program answered. The gateway may still answer."""
        self._foreign = words

    def on_query_failed(self, words: str, at: float) -> None:
        """Handle a query that ended without an answer.

        A stop, or a command to a gateway that a supervisor restarts, waits until its deadline. Any other command is
        given up.
        """
        if self._is_supervised and not self.answered:
            self.on_presence(at, alive=False)
        elif self._verb in STOP_VERBS and not self.answered:  # the gateway or the bus may be back in a moment
            self._why_unanswered = f"{self._foreign}. {words}" if self._foreign else words
            self.on_presence(at, alive=False)
        else:
            self._give_up_unanswered(words, at)

    def _give_up_unanswered(self, words: str, at: float) -> None:
        """Give up, unless the gateway has answered or sent an event."""
        if not self.answered:
            words = f"{self._foreign}. {words}" if self._foreign else words
            self._end(NO_ANSWER, "", words, at, ok=False)

    def on_query_timeout(self, at: float) -> None:
        """Handle the timeout of the query. Give up, unless the gateway has answered or a supervisor restarts it."""
        late = f"no answer after {at - self._asked_at:.0f} s"
        if self._gone_at is None:
            words = f"It is unknown what {self.car} does: its gateway is overloaded or hangs ({late}). Look at the car."
        elif self._is_supervised:
            return  # a new gateway may still answer
        else:
            words = f"{self.car} may be moving: its gateway is gone ({late}). Look at the car."
        self._give_up_unanswered(words, at)

    def on_presence(self, at: float, *, alive: bool) -> None:
        """Note that the gateway's token came back, or disappeared (the gateway was killed or lost its bus)."""
        if alive:
            self._gone_at = None
        elif self._gone_at is None:
            self._gone_at = at

    def give_up(self, at: float) -> None:
        """End because the deadline has passed. The outcome is unknown, unless this command has extended a drive."""
        if self.awaits_bus:
            self._end(NO_ANSWER, "", bus_lost_words(self.car), at, ok=False)
            return
        if self._why_unanswered and not self.answered:
            self._end(NO_ANSWER, "", self._why_unanswered, at, ok=False)
            return
        if self._gone_at is not None:
            words = (
                f"{self.car} may be moving, and no command reaches it: its gateway is gone. Go to the car, or start "
                "the gateway again (`fleet up`), which stops the car."
            )
            self._end(self._phase, "", words, at, ok=False)
            return
        if self._extends_drive:
            self._basis = Basis.SENT
            self._end(Phase.SENT, "", "the running drive was extended", at, ok=True)
            return
        words = (
            f"It is unknown what {self.car} does: no result after {at - self._asked_at:.1f} s "
            f"(last event: {self._phase}, {at - self._last_event_at:.1f} s ago). Look at the car."
        )
        self._end(self._phase, "", words, at, ok=False)

    def _note(self, phase: str, reason: str, words: str, at: float) -> None:
        if not self.answered and at - self._asked_at > LATE_ANSWER_S:
            self._timeout_from = at
        self._last_event_at = at
        self._queued = self._queued or phase == Phase.QUEUED
        if phase == Phase.QUEUED and not self._sent_event:
            self.why_waiting = words or self.why_waiting
        elif phase != Phase.ASKED:
            self.why_waiting = ""
        was_overtaken = phase in (Phase.ASKED, Phase.QUEUED) and self._phase in (Phase.SENT, Phase.COMPLETE)
        if not was_overtaken:
            self._phase = phase
        if phase in _FAILED_PHASES:
            self._end(phase, reason, words, at, ok=False)
        elif phase == Phase.COMPLETE or (phase == Phase.SENT and self._until is Until.SENT):
            self._end(phase, reason, words, at, ok=reason not in _STILL_STOPPED)

    def _failure(self, phase: str, reason: str) -> tuple[str, ...]:
        """Return the results that choose the text of a failure, the most specific first."""
        if phase == Phase.EXPIRED and self._sent_event:  # a drive whose sender is gone was driven until then
            return (Phase.SUPERSEDED,)
        return (reason, phase if phase in _FAILED_PHASES else "")

    def _end(self, phase: str, reason: str, words: str, at: float, *, ok: bool) -> None:
        if self.outcome is None:
            took_s = at - self._asked_at
            done = UNCONFIRMED if self._basis == Basis.SENT else self._basis or phase
            effect = describe(
                self._verb,
                (done, phase) if ok else self._failure(phase, reason),
                car=self.car,
                detail="" if words and self._until is Until.OVER else self._detail,
                words=words,
                took_s=took_s,
            )
            worst_case_s = None if self._until is Until.OVER else self._worst_case_s or None
            is_in_force = ok or reason == Reason.NOT_SHOWN  # an e-stop is in force even if no reading shows the stop
            after = NEXT_STEPS.get(self._verb, "").format(car=self.car) if is_in_force else ""
            # The effect of a command that was carried out contains the gateway's words, if there are any.
            told = (effect or words) if ok else (words or effect)
            told = told or f"{self._verb or 'command'} {phase}"
            self.outcome = Outcome(
                self.car, ok, str(phase), str(reason), told, worst_case_s, took_s, str(self._basis), effect, after
            )
