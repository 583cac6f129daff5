"""The timeout of a phase, and the parts of a plan's state that outlive the coordinator."""

from pathlib import Path

import pytest

from fleet.coordinator.plan_state_file import CoordinatorStateFile
from fleet.policy.phases import PHASE_SETTLE_TIMEOUT_S
from fleet.policy.plan.plan_parser import parse
from fleet.policy.plan_requests import PlanRequest, on_request
from fleet.policy.snapshot import FleetSnapshot
from fleet.policy.state import PersistedPolicy, restore, to_persisted
from tests.fleet.policy.cars import GONE, HERE, PolicyRun

PLAN = parse(
    "roles: {track: {mode: tracking, cars: [red]}, rest: {mode: manual, cars: [red]}}\n"
    "phases: {work: {roles: [track], timeout_s: 5, next: done}, done: {roles: [rest]}}"
)


def ends_at(run: PolicyRun) -> float:
    """Return the time at which the phase ends, to a tenth."""
    while run.at(round(run.now + 0.1, 1)).memory.phase.name == "work":
        assert run.now < 60.0
    return run.now


@pytest.mark.parametrize(
    ("before", "known_at", "in_mode_at", "ends"),
    [
        (HERE, 0.0, 0.1, 5.1),  # obeys at once
        (HERE, 0.0, 4.0, 9.0),  # the mode opens slowly
        (GONE, 7.0, 8.0, 13.0),  # its gateway comes late
        (HERE, 0.0, 60.0, PHASE_SETTLE_TIMEOUT_S + 5.1),  # never obeys: the wait is limited
    ],
)
def test_phase_timeout_counts_from_cars_in_modes(
    before: object, known_at: float, in_mode_at: float, ends: float
) -> None:
    run = PolicyRun(PLAN, "red", obey=False)
    run.cars["red"] = before  # type: ignore[assignment]  # HERE or GONE
    run.at(0.1)
    while run.now < min(in_mode_at, 40.0) and run.memory.phase.name == "work":
        if run.now >= known_at:
            run.change("red", present=True, mode="manual", verdict="confirmed", link="online", motors="off")
        run.at(round(run.now + 0.1, 1))
    run.change("red", mode="tracking", verdict="assumed")
    assert (run.now if run.memory.phase.name == "done" else ends_at(run)) == pytest.approx(ends, abs=0.3)


def test_phase_start_waits_for_recovery_not_for_hold() -> None:
    for fields, ends in (({"motors": "unknown"}, 12.0), ({"held_by": "ann"}, 5.1)):
        run = PolicyRun(PLAN, "red")
        run.change("red", **fields)
        run.until(7.0) if "motors" in fields else run.at(0.1)
        run.change("red", motors="off")
        assert ends_at(run) == pytest.approx(ends, abs=0.3), fields


def test_phase_and_rules_last_one_run_and_roles_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    run = PolicyRun(PLAN, "red")
    run.until(12.0)
    assert run.memory.phase.name == "done"
    CoordinatorStateFile("fleet", "tcp/x", "run-1").save(to_persisted(PLAN, run.memory, run.now, 1000.0))

    def begins(name: str) -> str:
        kept = CoordinatorStateFile("fleet", "tcp/x", name).load()
        assert kept.roles == {"red": "rest"}
        memory = restore(PLAN, FleetSnapshot(run.cars), kept, 0.0, 1001.0)
        run.memory = memory
        return run.at(0.1).memory.phase.name

    assert begins("run-1") == "done", "its coordinator was killed"
    assert begins("run-2") == "work", "a new fleet up"
    assert CoordinatorStateFile("fleet", "tcp/y", "run-1").load() == PersistedPolicy()
    file = CoordinatorStateFile("fleet", "tcp/x", "run-1")
    assert file.path is not None
    file.path.unlink()
    file.path.mkdir()  # it cannot be written
    state = to_persisted(PLAN, run.memory, run.now, 1000.0)
    assert [file.save(state), file.save(state)] == [False, False]
    file.path.rmdir()
    assert file.save(state)
    assert file.load() == state


def test_restarted_plan_begins_with_its_first_phase() -> None:
    run = PolicyRun(PLAN, "red")
    run.until(12.0)
    run.memory, words = on_request(PlanRequest.RESTART, PLAN, run.memory, "ann", 12.1)
    assert {PLAN.version, "work"} <= set(words.split())
    step = run.at(12.1)
    assert step.memory.phase.name == "work"
    assert [each.decided for each in step.changed if each.subject == "phase"] == ["work"]


@pytest.mark.parametrize("step_s", [-3600.0, 0.0, 3600.0])
def test_wall_clock_step_does_not_change_phase_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    """The clock is set while the coordinator runs. The next one must not take the step for time that has passed."""
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    run = PolicyRun(PLAN, "red")
    run.until(3.0)
    file, wall_s = CoordinatorStateFile("fleet", "tcp/x", "run-1"), 100_000.0
    file.save(to_persisted(PLAN, run.memory, run.now, wall_s))
    file.save(to_persisted(PLAN, run.memory, run.now, wall_s + step_s))
    memory = restore(PLAN, FleetSnapshot(run.cars), file.load(), run.now, wall_s + step_s)
    assert memory.phase.since == pytest.approx(run.memory.phase.since, abs=0.2)
