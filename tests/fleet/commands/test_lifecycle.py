"""Time for which `fleet down` waits for a supervisor, and the line of a process in `fleet status`."""

import threading
from typing import Any

import pytest

from fleet.commands import lifecycle
from schemas import keys
from schemas.bus import Bus
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for

TOKEN = keys.car_token("fleet", keys.SUPERVISOR)


class Down:
    """`fleet down` in a thread, while it waits for the end."""

    def __init__(self, bus: Bus) -> None:
        self.received: list[Any] = []
        self.found: list[tuple[Any, bool]] = []
        self.thread = threading.Thread(target=lambda: self.found.append(self._wait(bus)))
        self.thread.start()

    def _wait(self, bus: Bus) -> tuple[Any, bool]:
        return lifecycle._until_ended(bus, "fleet", self.received)


def test_supervisor_with_token_gap_has_not_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifecycle, "SUPERVISOR_LOST_S", 5.0)
    endpoint = free_endpoint()
    with Bus.open(endpoint, start_hub=True) as ours, Bus.open(endpoint) as theirs:
        down = Down(ours)
        for _ in range(3):
            token = theirs.token(TOKEN)
            wait_for(lambda: ours.tokens(TOKEN), "the token")
            down.thread.join(3 * lifecycle.FLEET_DOWN_POLL_S)  # the command also queries the token
            token.undeclare()
            down.thread.join(1.0)
            assert down.thread.is_alive()
        ended = pb.Supervision(state="ended")
        down.received.append(ended)
        down.thread.join(5.0)
        assert down.found == [(ended, False)]


def test_supervisor_without_a_token_and_a_status_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifecycle, "SUPERVISOR_LOST_S", 1.0)
    with Bus.open(free_endpoint(), start_hub=True) as ours:
        down = Down(ours)
        down.thread.join(10.0)
        assert down.found == [(None, True)]


def test_hub_of_another_program_is_no_reason_for_a_restart() -> None:
    """It said "started again once: another program's hub listens", of a hub that had been killed."""
    hub = pb.Supervised(name="@hub", kind="hub", state="elsewhere", restarts=1, words="another program's hub listens")
    assert lifecycle._describe_process(hub).endswith(" no process: another program's hub listens")
    hub.state, hub.pid, hub.words = "running", 7, "was ended by signal 9"
    assert lifecycle._describe_process(hub).endswith(" process 7, started again once: was ended by signal 9")
