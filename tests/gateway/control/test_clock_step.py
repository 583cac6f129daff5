"""The wall clock steps by an hour while a gateway runs: no lease, loan, hold, pause or e-stop notices. Virtual time."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.bus.car_service import Request
from gateway.bus.command_parser import parse
from gateway.control.commands import Answer
from gateway.control.safety_state import LEASE_S, PersistedSafety, Safety
from schemas import messages
from schemas.commands import COMMANDS
from schemas.rights import Loan
from schemas.words import Motion, Phase, Rank, Reason
from tests.gateway.control.workbench import Workbench

S = 1_000_000_000
HOUR = 3600 * S
BEGAN = 1_795_000_000 * S
STEPS = st.sampled_from([-HOUR, 0, HOUR])
FAR = (-(1 << 62), -BEGAN // S, -3600, -60, 60, 3600, 1 << 40, 1 << 62)
"""Seconds by which the clock of a sender is wrong."""


class Gateway:
    """A gateway and its senders on one computer, whose wall clock somebody sets."""

    def __init__(self) -> None:
        self.desk = Workbench().ready()
        self._offset_ns = BEGAN - int(self.desk.now * S)

    @property
    def wall_ns(self) -> int:
        return self._offset_ns + int(self.desk.now * S)

    def step(self, ns: int) -> None:
        self._offset_ns += ns

    def ask(self, verb: str, *, ahead_s: int = 0, sender: str = "ann", **fields: object) -> Answer:
        name = COMMANDS[verb].message
        message: Any = messages.message_class(name)(sender=sender, kind="person", **fields)
        message.asked.seconds = min(max(self.wall_ns // S + ahead_s, -(1 << 63)), (1 << 63) - 1)
        request = Request(verb, message.SerializeToString(), messages.encoding_of(name))
        answer = self.desk.control.command(parse(request, self.wall_ns), self.desk.now)
        self.desk.pump()
        return answer


@given(st.lists(STEPS, min_size=6, max_size=6))
def test_durations_survive_wall_clock_steps(steps: list[int]) -> None:
    gateway = Gateway()
    desk, safety = gateway.desk, gateway.desk.control.safety

    def wait(seconds: float) -> None:
        gateway.step(steps.pop())
        desk.run(seconds)

    assert gateway.ask("lease").reason is None
    wait(LEASE_S - 0.5)
    assert gateway.ask("drive", sender="bob", motion="forward").reason is Reason.LEASED
    wait(0.6)
    assert safety.lease_at(desk.now) is None
    assert gateway.ask("lend", to="mia", duration_s=60.0).reason is None
    wait(59.0)
    assert gateway.ask("drive", sender="bob", motion="forward").reason is Reason.LENT
    wait(1.5)
    assert safety.loan is None
    gateway.ask("stop")
    gateway.ask("estop", sender="mia")
    gateway.ask("pause")
    wait(30.0)
    wait(30.0)
    assert safety.hold is not None
    assert (safety.hold.by, len(safety.estops), len(safety.pauses)) == ("ann", 1, 1)


@pytest.mark.parametrize("ahead_s", FAR)
@pytest.mark.parametrize("verb", COMMANDS)
def test_sender_with_wrong_clock_may_only_stop_and_pause(verb: str, ahead_s: int) -> None:
    fields: dict[str, dict[str, Any]] = {
        "drive": {"motion": Motion.FORWARD},
        "mode": {"mode": "tracking"},
        "led": {"r": 1, "g": 2, "b": 3},
        "light": {"light": "red"},
        "servo": {"deg": 90},
        "arm": {"joint_deg": [90] * 6},
        "speed": {"step": "up"},
        "lend": {"to": "mia", "duration_s": 60.0},
    }
    answer = Gateway().ask(verb, ahead_s=ahead_s, **fields.get(verb, {}))
    if verb in ("stop", "estop", "pause"):
        assert (answer.status, answer.reason) == (Phase.QUEUED, None)
    else:
        assert (answer.status, answer.reason) == (Phase.REJECTED, Reason.STALE)


@pytest.mark.parametrize(("step_ns", "left_s"), [(-HOUR, 600.0), (0, 540.0), (HOUR, -3060.0)])
def test_clock_step_without_gateway_prolongs_no_loan(step_ns: int, left_s: float) -> None:
    loan = Loan("mia", "ann", Rank.PERSON, BEGAN, 600.0)
    safety = Safety.restore(PersistedSafety(loan=loan), 50.0, BEGAN + 60 * S + step_ns)
    assert safety.loan_until == 50.0 + left_s
