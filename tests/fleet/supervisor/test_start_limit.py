"""The processes that may start or be killed now, by tables and on virtual time."""

import pytest

from fleet.supervisor.start_limit import (
    KILL_INTERVAL_S,
    KILLS_AT_ONCE,
    RESTART_INTERVAL_S,
    RESTARTS_AT_ONCE,
    START_SLOT_TIMEOUT_S,
    Admission,
)


@pytest.mark.parametrize(
    ("starting_since", "admitted"),
    [
        ([], True),
        ([99.0], True),
        ([99.0, 99.5], False),
        ([99.0, 100.0 - START_SLOT_TIMEOUT_S], True),  # the slot of one has timed out
        ([0.0, 1.0, 2.0, 3.0], True),
    ],
)
def test_admission_waits_for_predecessor_heard_or_timed_out(starting_since: list[float], admitted: bool) -> None:
    assert Admission(2).admit_start(100.0, starting_since, restart=False) is admitted


def test_restart_budget_is_fleet_wide_without_first_starts() -> None:
    admission = Admission(100)
    assert all(admission.admit_start(0.0, [], restart=False) for _ in range(1000))
    assert sum(admission.admit_start(0.0, [], restart=True) for _ in range(1000)) == RESTARTS_AT_ONCE
    later = 5 * RESTART_INTERVAL_S
    assert sum(admission.admit_start(later, [], restart=True) for _ in range(1000)) == 5


def test_kills_have_a_budget_for_the_whole_fleet() -> None:
    admission, killed = Admission(2), 0
    for tenth in range(round(10 * 4 * KILL_INTERVAL_S)):
        if admission.may_kill(tenth / 10):
            admission.count_kill(tenth / 10)
            killed += 1
    assert killed == KILLS_AT_ONCE + 3


@pytest.mark.parametrize("count", [1, 10, 100])
@pytest.mark.parametrize("work_s", [0.3, 1.0])
def test_fleet_starts_one_by_one_within_places(count: int, work_s: float) -> None:
    """On virtual time, starting processes share two processors, and each needs `work_s` of one."""
    admission, waiting, starting, now, most = Admission(3), count, list[list[float]](), 0.0, 0
    while waiting or starting:
        if waiting and admission.admit_start(now, [since for since, _ in starting], restart=False):
            waiting -= 1
            starting.append([now, work_s])
        most = max(most, len(starting))
        for each in starting:
            each[1] -= 0.1 * min(1.0, 2 / len(starting))
        starting = [each for each in starting if each[1] > 0]
        now += 0.1
    assert most <= 3
    assert now < count * work_s + 1.0, "no processor waits for long"
