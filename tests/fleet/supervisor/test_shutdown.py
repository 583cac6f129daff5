"""What the end of a gateway says of its car: stopped, stop sent, not confirmed, not stopped, never reached."""

from pathlib import Path
from typing import Any

import pytest

from fleet.client.claims import NOT_CONFIRMED, NOT_STOPPED, STOP_SENT, STOPPED
from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.log_files import Log
from fleet.supervisor.process_state import ProcessState
from fleet.supervisor.processes import ManagedProcess, ProcessSet
from fleet.supervisor.shutdown import LAST_CLAIM_TIMEOUT_S, NEVER_REACHED, GatewayShutdown, describe_end
from fleet.supervisor.spec import PATIENCE
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import ProcessKind

SHOWN = pb.Safety(motors="off", motors_basis="shown", boot_id="a")
SENT = pb.Safety(motors="off", motors_basis="sent", trust_evidence="red sends no readings", boot_id="a")
UNKNOWN = pb.Safety(motors="unknown", boot_id="a")
ONLINE, LOST = pb.Link(state="online", boot_id="a", rx_bytes=41), pb.Link(state="lost", boot_id="a")
ACCEPTED = pb.Link(state="stale", boot_id="a", since_s=0.1)
"""A bridge that is in use accepts a connection, and closes it."""
SILENT = pb.Link(state="stale", boot_id="a", since_s=5.0)


class Shutdown:
    """A shutdown of one car's gateway, which has ended."""

    def __init__(self, directory: Path, code: int, states: list[Any]) -> None:
        self.processes = ProcessSet(lambda *_: None, lambda *_: True, lambda *_: None)
        self.row = CarStatus("red")
        for state in states:
            self.row.take(f"state/{type(state).__name__.lower()}", state, 0.0)
        self.shutdown = GatewayShutdown(self.processes, {"red": self.row}, lambda *_: None)
        status = ProcessState(PATIENCE[ProcessKind.GATEWAY], 0.0)
        self.process = ManagedProcess("red", ProcessKind.GATEWAY, (), status, Log(directory / "red.log"))
        self.process.status.on_started(0.0)
        self.shutdown.begin(self.process)
        self.process.status.end(1.0, 5.0)
        self.process.code = code
        self.process.status.on_exit(code, "", 2.0, 0.0)
        self.shutdown.hurry()  # one gateway is enough here
        self.shutdown.on_exit(self.process)
        self.row.reset()

    @property
    def words(self) -> str:
        return self.shutdown.results.get("red", "")


@pytest.mark.parametrize(
    ("code", "states", "begins", "bad"),
    [
        (0, [ONLINE, SHOWN], STOPPED, False),
        (0, [ONLINE, SENT], f"{STOP_SENT}, red sends no readings", False),
        (1, [ONLINE, UNKNOWN], NOT_CONFIRMED, True),
        (1, [ONLINE, UNKNOWN, LOST], NOT_STOPPED, True),
        (1, [LOST, UNKNOWN], NEVER_REACHED, False),
        (1, [ACCEPTED, LOST, UNKNOWN], NEVER_REACHED, False),
        (1, [SILENT, UNKNOWN], NOT_CONFIRMED, True),
        (1, [ONLINE, SHOWN, LOST], STOPPED, False),
    ],
)
def test_shutdown_words_of_each_end(tmp_path: Path, code: int, states: list[Any], begins: str, bad: bool) -> None:
    shutdown = Shutdown(tmp_path, code, states)
    assert shutdown.words.startswith(begins)
    assert shutdown.shutdown.not_stopped == (["red"] if bad else [])
    assert shutdown.shutdown.pending == []


def test_last_state_of_gateway_may_follow_its_end(tmp_path: Path) -> None:
    shutdown = Shutdown(tmp_path, 0, [ONLINE, pb.Safety(motors="stopping", boot_id="a")])
    assert (shutdown.words, shutdown.shutdown.pending) == ("", ["red"])
    shutdown.row.take("state/safety", SHOWN, 0.0)
    shutdown.shutdown.turn(0.0)
    assert (shutdown.words, shutdown.shutdown.pending) == (STOPPED, [])


def test_if_it_does_not_come_nothing_was_shown(tmp_path: Path) -> None:
    shutdown = Shutdown(tmp_path, 0, [ONLINE, pb.Safety(motors="stopping", boot_id="a")])
    shutdown.shutdown._unclaimed["red"] -= LAST_CLAIM_TIMEOUT_S
    shutdown.shutdown.turn(0.0)
    assert shutdown.words == STOP_SENT


@pytest.mark.parametrize(
    ("results", "words"),
    [
        ({}, "no car had been started"),
        ({"red": "its gateway had not started, so it got no command"}, "no car had been started"),
        ({"red": STOPPED, "blue": STOPPED}, "every car that was started is stopped"),
        ({"red": STOPPED, "blue": f"{STOP_SENT}, blue is deaf"}, f"{STOPPED}: red; {STOP_SENT}: blue"),
        (
            {"red": STOPPED, "blue": f"{NOT_STOPPED}: x", "green": f"{NOT_CONFIRMED}: y"},
            f"{NOT_STOPPED}: blue; {NOT_CONFIRMED}: green. They may be moving: go to them.",
        ),
    ],
)
def test_end_in_one_line(results: dict[str, str], words: str) -> None:
    assert describe_end(results) == words
