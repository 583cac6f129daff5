"""Nothing that comes over the bus ends a coordinator: it answers with an error, logs an event, and goes on."""

import json
import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fleet import Fleet
from fleet.cli import cli
from fleet.coordinator.coordinator import Coordinator
from fleet.coordinator.other_coordinators import SENDER
from fleet.coordinator.publications import INTERNAL_ERROR
from fleet.policy.decision import Decision
from fleet.policy.plan.plan_parser import parse
from schemas import keys, messages
from schemas.bus import Failure, Sample
from schemas.topics import TOPICS
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, wait_for
from tests.support.processes import FleetProcesses as Processes

PHASES = "roles: {rest: {mode: manual}}\nphases: {work: {timeout_s: 1.5, next: done}, done: {}}"
PLAN = "roles: {rest: {mode: manual, count: all}}"
KEY = "fleet/@coordinator/@cmd/plan"


@dataclass
class Started:
    """A coordinator on a thread, its decisions, and its messages. `broken`: the receiver of its messages fails."""

    processes: Processes
    decided: "queue.Queue[Decision]" = field(default_factory=queue.Queue)
    said: list[str] = field(default_factory=list)
    broken: bool = False
    persisted: list[tuple[str, str]] = field(default_factory=list)
    """Each decided phase, and the phase in the state file at that moment."""

    def on_decision(self, decision: Decision) -> None:
        if decision.subject == "phase":
            (path,) = self.processes.directory.rglob("*.@coordinator.json")
            self.persisted.append((decision.decided, json.loads(path.read_text())["phase"]))
        self.decided.put(decision)

    def failed(self, words: str) -> None:
        self.said.append(words)
        if self.broken:
            raise RuntimeError("nobody foresaw it")

    def ask(self, payload: bytes) -> Any:
        """Request another plan. Return the result, or the text of the error."""
        (answer,) = self.processes.bus.query(KEY, payload=payload, timeout_s=10.0)
        return answer.words if isinstance(answer, Failure) else answer.message()

    def goes_on(self, plan: str) -> None:
        """Set another plan, and check that the coordinator follows it."""
        assert self.ask(plan.encode()).status == "sent"
        while self.decided.get(timeout=PATIENCE_S).subject != "role further":
            pass


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Started]:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    processes, ended = Processes(free_endpoint(), tmp_path), threading.Event()
    one = Started(processes)
    with Fleet(processes.endpoint, sender=f"{SENDER}x", kind="coordinator") as client:
        coordinator = Coordinator(client, parse(PLAN), one.on_decision, one.failed)
        thread = threading.Thread(target=coordinator.run, args=(ended.is_set,))
        thread.start()
        try:
            one.decided.get(timeout=PATIENCE_S)
            yield one
            assert thread.is_alive()
        finally:
            ended.set()
            thread.join()
            processes.close()


def test_coordinator_survives_and_logs_internal_error(started: Started) -> None:
    logged: list[Sample] = []
    started.processes.bus.subscribe("fleet/@coordinator/log", logged.append)
    started.broken = True
    words = started.ask(b"fixed: {purple: {mode: manual}}")  # its warning goes to the broken receiver
    started.broken = False
    assert isinstance(words, str)
    assert words.startswith(f"{INTERNAL_ERROR} while answering {KEY}: RuntimeError at test_guard.py:")
    (event,) = wait_for(
        lambda: [each for each in map(Sample.message, logged) if INTERNAL_ERROR in str(each)], "the event"
    )
    assert (event.name, event.message, event.level) == (f"@coordinator {INTERNAL_ERROR}", words, 4)
    assert words in started.said
    started.goes_on("roles: {further: {mode: manual}}")


def test_coordinator_survives_foreign_payloads(started: Started) -> None:
    bus = started.processes.bus
    bus.token(keys.car_token("fleet", "red"))
    bus.token("fleet/NO-CAR!")
    for topic in ("link", "mode", "motion", "safety", "health"):
        for name in ("fleet.v1.Battery", "fleet.v1.Mode", "fleet.v1.Result", "foxglove.Log", "fleet.v1.Nothing"):
            bus.put_command(f"fleet/red/state/{topic}", b"", messages.encoding_of(name))
            bus.put_command(f"fleet/red/state/{topic}", b"\xff{[", messages.encoding_of(name))
        bus.put_command(f"fleet/red/state/{topic}", b"[" * 10_000, messages.JSON)
    long = " or ".join(["battery.voltage_v < 7"] * 40)
    assert 950 < len(long) < 1000
    assert "status" in str(started.ask(f'roles: {{x: {{mode: manual, needs: "{long}"}}}}'.encode()))
    assert started.ask(b"\xff\xfe").reason == "bad_value"
    started.goes_on("roles: {further: {mode: manual, count: all}}")
    assert not [words for words in started.said if INTERNAL_ERROR in words]


def test_finished_plan_begins_anew_when_it_is_restarted(started: Started) -> None:
    def until(phase: str) -> None:
        while (decision := started.decided.get(timeout=PATIENCE_S)).subject != "phase" or decision.decided != phase:
            pass

    bus = started.processes.bus
    bus.token(keys.car_token("fleet", "red"))
    topic = {name: TOPICS[f"state/{name}"] for name in ("link", "mode", "motion", "safety")}
    said = {
        "link": {"state": "online"},
        "mode": {"asked": "manual", "verdict": "confirmed"},
        "safety": {"motors": "off"},
    }
    for name, each in topic.items():
        message: Any = messages.message_class(each.message)(**said.get(name, {}))
        bus.put_command(f"fleet/red/state/{name}", message.SerializeToString(), messages.encoding_of(each.message))
    assert started.ask(PHASES.encode()).status == "sent"
    until("work")
    until("done")
    done = CliRunner().invoke(cli, ["plan", "restart", "--connect", started.processes.endpoint])
    assert (done.exit_code, done.output.strip()) == (0, f"plan {parse(PHASES).version} starts again with phase work")
    until("work")
    until("done")


def test_decision_is_persisted_before_it_is_published(started: Started) -> None:
    """Otherwise a coordinator that is killed at that moment leaves commands that the next one does not know."""
    assert started.ask(PHASES.encode()).status == "sent"
    wait_for(lambda: len(started.persisted) == 2, "both phases are decided")
    assert started.persisted == [("work", "work"), ("done", "done")]
