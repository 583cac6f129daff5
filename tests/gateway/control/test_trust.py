"""Tests of the trust state machine: every state and event, by rules that hold for the whole table."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.trust import STOP_GOES_ON, TRANSITIONS, TrustEvent, TrustState
from schemas.words import Basis, CarTrust

EVERYTHING = list(product(CarTrust, TrustEvent))
ENDS_A_STOP = {TrustEvent.STOP_SHOWN: Basis.SHOWN, TrustEvent.STOP_SENT: Basis.SENT}
MOTORS = {
    CarTrust.UNKNOWN: "unknown",
    CarTrust.RECOVERING: "unknown",
    CarTrust.STOPPING: "stopping",
    CarTrust.STOPPED: "off",
    CarTrust.DRIVING: "on",
    CarTrust.IN_MODE: "on",
    CarTrust.UNHEARD: "unknown",
    CarTrust.UNPROVEN: "unknown",
}

each_transition = pytest.mark.parametrize(("state", "event"), EVERYTHING, ids=lambda value: value.name)


def test_every_state_answers_every_event() -> None:
    assert set(TRANSITIONS) == set(EVERYTHING)
    assert set(TRANSITIONS.values()) == set(CarTrust), "no state is out of reach"


@each_transition
def test_transition(state: CarTrust, event: TrustEvent) -> None:
    after = TRANSITIONS[state, event]
    if event is TrustEvent.LINK_LOST:
        assert after is CarTrust.UNKNOWN
    if state is CarTrust.UNKNOWN and event is not TrustEvent.LINK_OPENED:
        assert after is CarTrust.UNKNOWN, "without a link nothing is learned"
    if event is TrustEvent.LINK_OPENED:
        assert after is CarTrust.RECOVERING
    if after is CarTrust.STOPPED and state is not CarTrust.STOPPED:
        assert event in ENDS_A_STOP, "only evidence, or the lack of any, ends a stop"
        assert state in STOP_GOES_ON
    if event is TrustEvent.STOP_BEGUN and state is not CarTrust.UNKNOWN:
        assert after in STOP_GOES_ON
    if event in ENDS_A_STOP and state in STOP_GOES_ON:
        silent = (state, event) == (CarTrust.UNHEARD, TrustEvent.STOP_SENT)
        assert after is (CarTrust.UNHEARD if silent else CarTrust.STOPPED), "only a reading ends the silence"
    if after in (CarTrust.DRIVING, CarTrust.IN_MODE) and state is not after:
        assert event in (TrustEvent.MOTION_SENT, TrustEvent.MODE_SENT), "the car only moves if we send something"
    if state in STOP_GOES_ON and event in (
        TrustEvent.SILENT,
        TrustEvent.NOT_SHOWN,
        TrustEvent.DOUBTED,
        TrustEvent.HEARD,
    ):
        assert after in STOP_GOES_ON, "no doubt ends a stop"


@each_transition
def test_trust_transitions_state_motors_and_basis(state: CarTrust, event: TrustEvent) -> None:
    basis = Basis.SENT if state is CarTrust.STOPPED else None
    trust = TrustState(state, 1.0, "before", basis)
    changed = trust.apply(event, 2.0, "words")
    assert trust.state is TRANSITIONS[state, event]
    assert trust.motors == MOTORS[trust.state]
    assert (trust.basis is not None) == (trust.state is CarTrust.STOPPED)
    assert trust.shown == (trust.basis is Basis.SHOWN)
    assert changed == ((trust.state, trust.basis) != (state, basis))
    assert (trust.since, trust.evidence) == ((2.0, "words") if changed else (1.0, "before"))
    if event in ENDS_A_STOP and trust.state is CarTrust.STOPPED:
        assert trust.basis is ENDS_A_STOP[event]


def test_event_is_its_own_evidence() -> None:
    trust = TrustState()
    assert trust.evidence == "not connected yet"
    trust.apply(TrustEvent.LINK_OPENED, 1.0)
    assert trust.evidence == TrustEvent.LINK_OPENED


@given(st.lists(st.sampled_from(TrustEvent), max_size=30))
def test_stop_goes_on_until_shown_or_sent_after_any_story(story: list[TrustEvent]) -> None:
    trust = TrustState()
    linked = False
    for number, event in enumerate(story):
        trust.apply(event, float(number))
        linked = event is TrustEvent.LINK_OPENED or (linked and event is not TrustEvent.LINK_LOST)
        assert (trust.state is not CarTrust.UNKNOWN) == linked
        assert (trust.basis is not None) == (trust.motors == "off")
    trust.apply(TrustEvent.STOP_BEGUN, 100.0)
    assert not linked or trust.state in STOP_GOES_ON
    trust.apply(TrustEvent.STOP_SHOWN, 101.0)
    assert (trust.motors, trust.shown_at) == ("off", 101.0) if linked else trust.motors == "unknown"
