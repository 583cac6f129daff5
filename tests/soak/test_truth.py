"""Ten simulated hours of normal running in every mode, with echo, without, and between near walls: no false alarm."""

import time

import pytest

from schemas.words import Mode
from tests.support.normal import NormalRun, normal
from tests.support.truth import WORLDS

HOUR_S = 3600.0
CHARGES = 2
"""Number of cars for each world, one after the other. After three hours, the battery of one that drives is empty."""
PART_S = 10 * HOUR_S / len(WORLDS) / CHARGES


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", Mode)
def test_no_false_alarm_in_ten_hours(mode: Mode, world: str) -> None:
    began = time.process_time()
    runs = [NormalRun(world, seed) for seed in range(1, CHARGES + 1)]
    for run in runs:
        normal(run, mode, PART_S)
    alarms = [each for run in runs for each in run.alarms]
    total_s = sum(run.pair.now for run in runs)
    print(
        f"\n{mode}, {world}: {total_s / HOUR_S:.1f} h, {sum(run.commands for run in runs)} commands, "
        f"{len(alarms)} alarms, {total_s / (time.process_time() - began):.0f} simulated s per CPU s"
    )
    assert not alarms
