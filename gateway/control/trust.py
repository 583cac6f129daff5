"""Tracks as one state machine whether the car is known to stand or to move. Pure.

A car acknowledges nothing, so everything that a gateway believes about it is inferred: from the frames that it has
written, and from what the car reports of its own accord. It is tempting to have a flag, "is driving", that is set where
frames are written. But then a lost frame, a reset, or a second program at the port makes the flag a lie, and somebody
reaches for a car that "stands still". This module is the one place where the belief may change, so that the question
"why did you say that it stands still?" always has an answer: a state, since when, and the evidence.

Two events say that a stop is over, and the difference between them is the point of the whole machine. `STOP_SHOWN`:
readings of the car prove that it obeyed. `STOP_SENT`: the frames are written, and this car has no way to show more.
Both lead to `STOPPED`, but with a different `basis`, and whoever shows the claim must show its basis, too. If a car
could have shown its stop and did not, neither event happens: the car is `UNPROVEN`, its motors are unknown, and the
gateway continues to stop it.

Three states are kinds of not knowing, and each ends in its own way. `RECOVERING` follows an opened link or a
contradiction: only a completed stop ends it, since the car may be in any mode with half a frame in its buffer.
`UNHEARD` is silence: a stop that is merely sent cannot end it, because nothing says that anybody is there. A reading
ends it, and then the car is stopped first. `UNKNOWN` is the time without a link, in which neither frames nor readings
count.

Time alone never changes the state. A timeout is an event (`SILENT`, `NOT_SHOWN`), which other modules raise because
they know the usual interval between the reports of this car. Here, a timeout is one more row of a table. `TRANSITIONS`
has a next state for every state and event, so no combination is forgotten, and a test walks through all of them.
"""

from enum import StrEnum
from typing import Final

from msgspec import Struct

from schemas.words import Basis, CarTrust, Motors


class TrustEvent(StrEnum):
    """An event that may change the state of the car."""

    LINK_OPENED = "the link was opened"
    LINK_LOST = "the link was lost"
    STOP_BEGUN = "a stop began"
    DOUBTED = "readings contradict what the gateway believed"
    STOP_SHOWN = "the car showed that it stopped"
    STOP_SENT = "the stop was sent to a car that cannot confirm it"
    NOT_SHOWN = "the car did not show its stop in time"
    SILENT = "the car is silent for too long"
    HEARD = "the car sends readings again"
    MOTION_SENT = "a motion was sent"
    MODE_SENT = "a mode was opened"


_T, _E = CarTrust, TrustEvent
_ANY: Final = {
    _E.LINK_OPENED: _T.RECOVERING,
    _E.LINK_LOST: _T.UNKNOWN,
    _E.STOP_BEGUN: _T.STOPPING,
    _E.DOUBTED: _T.RECOVERING,
    _E.STOP_SHOWN: _T.STOPPED,
    _E.STOP_SENT: _T.STOPPED,
    _E.NOT_SHOWN: _T.UNPROVEN,
    _E.SILENT: _T.UNHEARD,
    _E.MOTION_SENT: _T.DRIVING,
    _E.MODE_SENT: _T.IN_MODE,
}
"""The next state by event; the tables below have the exceptions."""

_SAME: Final = {
    # Without a link no frame and no reading counts.
    _T.UNKNOWN: set(TrustEvent) - {_E.LINK_OPENED},
    # A stop that begins during recovery joins or replaces the recovery. The car's state stays unknown.
    _T.RECOVERING: {_E.STOP_BEGUN, _E.HEARD},
    _T.STOPPING: {_E.STOP_BEGUN, _E.HEARD},
    _T.STOPPED: {_E.HEARD, _E.NOT_SHOWN},
    _T.DRIVING: {_E.HEARD, _E.NOT_SHOWN, _E.STOP_SHOWN, _E.STOP_SENT},
    _T.IN_MODE: {_E.HEARD, _E.NOT_SHOWN, _E.STOP_SHOWN, _E.STOP_SENT},
    # A stop that is merely sent does not end the silence. Neither a new stop nor a reading alone ends the doubt.
    _T.UNHEARD: {_E.STOP_BEGUN, _E.STOP_SENT, _E.DOUBTED, _E.NOT_SHOWN, _E.SILENT},
    _T.UNPROVEN: {_E.STOP_BEGUN, _E.DOUBTED, _E.NOT_SHOWN, _E.HEARD},
}
_OTHER: Final = {(_T.UNHEARD, _E.HEARD): _T.RECOVERING}

TRANSITIONS: Final[dict[tuple[CarTrust, TrustEvent], CarTrust]] = {
    (state, event): _OTHER.get((state, event), state if event in _SAME[state] else _ANY.get(event, state))
    for state in CarTrust
    for event in TrustEvent
}
"""The next state for every state and event; a test checks all of them."""

STOP_GOES_ON: Final = frozenset({_T.RECOVERING, _T.STOPPING, _T.UNHEARD, _T.UNPROVEN})
"""States in which the gateway sends stops until one is over."""

KNOWN: Final = frozenset({_T.STOPPING, _T.STOPPED, _T.DRIVING, _T.IN_MODE})
"""States in which the last recovery is over and no write has failed since, so the car reads frames as meant."""

_MOTORS: Final = {
    _T.UNKNOWN: Motors.UNKNOWN,
    _T.RECOVERING: Motors.UNKNOWN,
    _T.STOPPING: Motors.STOPPING,
    _T.STOPPED: Motors.OFF,
    _T.DRIVING: Motors.ON,
    _T.IN_MODE: Motors.ON,
    _T.UNHEARD: Motors.UNKNOWN,
    _T.UNPROVEN: Motors.UNKNOWN,
}


class TrustState(Struct):
    """The current state, since when, and why. Times: s, monotonic."""

    state: CarTrust = CarTrust.UNKNOWN
    since: float = float("-inf")
    evidence: str = "not connected yet"
    basis: Basis | None = None
    """Set in `STOPPED` only."""
    shown_at: float | None = None
    """When the car showed its last stop."""

    def apply(self, event: TrustEvent, now: float, evidence: str = "") -> bool:
        """Apply an event. Return True if the state or its basis has changed."""
        before = self.state, self.basis
        self.state = TRANSITIONS[self.state, event]
        if event is TrustEvent.STOP_SHOWN and self.state is CarTrust.STOPPED:
            self.basis, self.shown_at = Basis.SHOWN, now
        elif event is TrustEvent.STOP_SENT and self.state is CarTrust.STOPPED:
            self.basis = Basis.SENT
        elif self.state is not CarTrust.STOPPED:
            self.basis = None
        changed = (self.state, self.basis) != before
        if changed:
            self.since = now
            self.evidence = evidence or event
        return changed

    @property
    def motors(self) -> Motors:
        """Return the claim about the motors."""
        return _MOTORS[self.state]

    @property
    def shown(self) -> bool:
        """Return True if the car has shown that it stands still, and no frame since then could have moved it."""
        return self.basis is Basis.SHOWN
