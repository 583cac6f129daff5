"""Starts, kills and restarts of a process, by tables and for any order of events."""

from dataclasses import dataclass
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.supervisor.process_state import (
    FIRST_RESTART_DELAY_S,
    GATEWAY_GRACE_S,
    MAX_RESTART_DELAY_S,
    RESTART_JITTER,
    STABLE_RUN_S,
    WRONG_USE_RETRY_S,
    Patience,
    ProcessState,
    RestartAction,
    delay_s,
)
from schemas.limits import SHUTDOWN_S
from schemas.words import RunState

LEAVES_BUS_S = 2.0
"""Time that a gateway on a busy machine needs to end after its wait."""
PATIENCE = Patience(start_s=20.0, silence_s=4.0)


def running(at: float = 100.0) -> ProcessState:
    state = ProcessState(PATIENCE, at)
    assert state.turn(at, None) is RestartAction.START
    state.on_started(at)
    assert state.on_heartbeat(at)
    return state


@pytest.mark.parametrize(
    ("falls", "delay"), [(1, 0.25), (2, 0.5), (3, 1.0), (4, 2.0), (5, 4.0), (6, 8.0), (7, 10.0), (1000, 10.0)]
)
def test_backoff_doubles_to_maximum_with_jitter(falls: int, delay: float) -> None:
    assert delay_s(falls, 0.5) == delay
    assert delay_s(falls, 0.0) == pytest.approx(delay * (1 - RESTART_JITTER))
    assert delay_s(falls, 1.0) == pytest.approx(delay * (1 + RESTART_JITTER))


def test_gateway_is_not_killed_before_its_evidence_timeout() -> None:
    state = running()
    assert state.end(200.0, GATEWAY_GRACE_S)
    assert state.turn(200.0 + SHUTDOWN_S + LEAVES_BUS_S, None) is RestartAction.NOTHING
    assert state.turn(200.0 + GATEWAY_GRACE_S, None) is RestartAction.KILL


def test_dead_process_is_restarted_after_delay() -> None:
    state = running()
    state.on_exit(-9, "", 101.0, 0.5)
    assert state.state is RunState.WAITING
    assert state.words.endswith(" signal 9")
    assert state.turn(101.0 + FIRST_RESTART_DELAY_S - 0.01, 0.0) is RestartAction.NOTHING
    assert state.turn(101.0 + FIRST_RESTART_DELAY_S, 0.0) is RestartAction.START
    state.on_started(102.0)
    assert (state.state, state.restarts) == (RunState.STARTING, 1)


def test_crash_loop_backs_off_and_steady_run_resets() -> None:
    state, at, delays = ProcessState(PATIENCE, 0.0), 0.0, []
    for _ in range(8):
        state.on_started(at)
        state.on_exit(1, "no", at + 0.1, 0.5)
        delays.append(state.due - at - 0.1)
        at = state.due
    assert delays == sorted(delays)
    assert delays[-1] == pytest.approx(MAX_RESTART_DELAY_S)
    state.on_started(at)
    state.on_heartbeat(at)
    state.on_exit(1, "no", at + STABLE_RUN_S, 0.5)
    assert state.due - at - STABLE_RUN_S == pytest.approx(FIRST_RESTART_DELAY_S)
    assert state.words.endswith(" 1: no")


def test_rejected_arguments_are_retried_each_minute_or_after_reload() -> None:
    state = running()
    state.on_exit(2, "no such platform", 101.0, 0.5)
    assert state.state is RunState.REFUSED
    assert state.words.endswith(" 2: no such platform")
    assert state.turn(101.0 + WRONG_USE_RETRY_S - 0.1, 0.0) is RestartAction.NOTHING
    assert state.turn(101.0 + WRONG_USE_RETRY_S, 0.0) is RestartAction.START
    state.end(120.0, 5.0, again=True)
    assert state.turn(120.0, 0.0) is RestartAction.START


@pytest.mark.parametrize(
    ("leave_s", "act"),
    [(0.0, RestartAction.KILL), (4.9, RestartAction.KILL), (5.1, RestartAction.NOTHING), (inf, RestartAction.NOTHING)],
)
def test_silent_process_may_be_left_longer_than_its_patience(leave_s: float, act: RestartAction) -> None:
    assert running(100.0).turn(105.0, 0.0, leave_s) is act


def test_ending_process_has_its_time_however_silent() -> None:
    state = running()
    state.end(110.0, 7.0)
    assert state.turn(117.0, 0.0, inf) is RestartAction.KILL


@pytest.mark.parametrize(
    ("now", "listening_since", "act"),
    [
        (103.9, 0.0, RestartAction.NOTHING),
        (104.1, 0.0, RestartAction.KILL),
        (200.0, None, RestartAction.NOTHING),  # no process could be observed
        (200.0, 197.0, RestartAction.NOTHING),  # the hub is back, or the supervisor runs again, for 3 s only
        (200.0, 195.9, RestartAction.KILL),
    ],
)
def test_silent_process_counts_as_hung_only_while_listening(
    now: float, listening_since: float | None, act: RestartAction
) -> None:
    state = running(100.0)
    assert state.turn(now, listening_since) is act
    if act is RestartAction.KILL:
        assert state.words.startswith("hung: ")
        assert state.killed
        assert state.turn(now + 10, listening_since) is RestartAction.NOTHING, "once is enough"
        state.on_exit(-9, "", now + 0.1, 0.5)
        assert state.words.startswith("hung"), "the reason stays the first"


def test_starting_process_has_longer_patience() -> None:
    state = ProcessState(PATIENCE, 0.0)
    state.on_started(100.0)
    assert state.turn(119.9, 0.0) is RestartAction.NOTHING
    assert state.turn(120.1, 0.0) is RestartAction.KILL


def test_ended_process_is_killed_after_timeout_and_not_restarted() -> None:
    state = running()
    assert state.end(110.0, 7.0)
    assert not state.end(111.0, 7.0), "told twice is told once"
    assert state.turn(116.9, 0.0) is RestartAction.NOTHING
    assert state.turn(117.0, 0.0) is RestartAction.KILL
    state.on_exit(-9, "", 117.1, 0.5)
    assert state.state is RunState.ENDED
    assert state.turn(1e6, 0.0) is RestartAction.NOTHING


def test_begun_anew_is_no_fall() -> None:
    state = running()
    state.end(110.0, 7.0, again=True)
    state.on_exit(0, "", 111.0, 0.5)
    assert state.turn(111.0, 0.0) is RestartAction.START
    assert not state.on_started(111.0)
    assert (state.restarts, state.words) == (0, ""), "`fleet doctor` would call it odd"
    state.on_exit(1, "no room", 112.0, 0.5)
    assert state.on_started(113.0)
    assert state.restarts == 1
    state.end(114.0, 7.0, again=True)
    assert state.turn(121.0, 0.0) is RestartAction.KILL
    state.on_exit(-9, "", 121.1, 0.5)
    assert state.on_started(122.0), "it was killed before it was started again"
    assert (state.restarts, state.words) == (2, "did not end in time and was killed")


def test_process_served_elsewhere_is_not_started() -> None:
    state = ProcessState(PATIENCE, 0.0)
    state.served_elsewhere(1.0, "somebody else's")
    assert state.turn(100.0, 0.0) is RestartAction.NOTHING
    state.schedule(101.0)
    assert state.turn(101.0, 0.0) is RestartAction.START


@dataclass
class FakeProcess:
    """The process of a state. At most one runs at a time."""

    alive: bool = False


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["turn", "heard", "die", "wrong", "end", "again", "deaf"]),
            st.floats(0.0, 30.0),
            st.floats(0.0, 1.0),
        )
    )
)
def test_restart_policy_runs_one_process_in_any_order(steps: list[tuple[str, float, float]]) -> None:
    state, process, now = ProcessState(PATIENCE, 0.0), FakeProcess(), 0.0
    for step, seconds, chance in steps:
        now += seconds
        if step in ("turn", "deaf"):
            act = state.turn(now, None if step == "deaf" else 0.0)
            if act is RestartAction.START:
                assert not process.alive
                process.alive = True
                state.on_started(now)
            elif act is RestartAction.KILL:
                assert process.alive
                process.alive = False
                state.on_exit(-9, "", now, chance)
        elif step == "heard" and process.alive:
            state.on_heartbeat(now)
        elif step in ("die", "wrong") and process.alive:
            process.alive = False
            state.on_exit(2 if step == "wrong" else 1, "", now, chance)
        elif step in ("end", "again"):
            assert state.end(now, 5.0, again=step == "again") <= process.alive
        assert state.alive == process.alive
        if state.state is RunState.WAITING:
            assert state.due <= now + MAX_RESTART_DELAY_S * (1 + RESTART_JITTER)


def test_hang_while_ending_is_killed_only_if_it_was_heard() -> None:
    for to_the_end in (True, False):
        state = ProcessState(Patience(start_s=20.0, silence_s=4.0, to_the_end=to_the_end), 100.0)
        state.on_started(100.0)
        state.on_heartbeat(101.0)
        state.end(110.0, 15.0)
        assert state.turn(114.0, None) is RestartAction.NOTHING, "nobody could be heard"
        assert state.turn(114.0, 112.0) is RestartAction.NOTHING
        state.on_heartbeat(112.5)
        assert state.turn(116.4, 112.0) is RestartAction.NOTHING
        assert state.turn(116.6, 112.0) is (RestartAction.KILL if to_the_end else RestartAction.NOTHING)
        assert state.turn(125.0, 112.0) is (RestartAction.NOTHING if to_the_end else RestartAction.KILL)
