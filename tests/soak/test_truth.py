"""Ten simulated hours of normal running in every mode, with echo, without, and between near walls: no false alarm."""

import time

import pytest

from schemas.words import Mode
from tests.support.normal import NormalRun, normal
from tests.support.truth import WORLDS

HOUR_S = 3600.0
PART_S = 10 * HOUR_S / len(WORLDS)


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", Mode)
def test_no_false_alarm_in_ten_hours(mode: Mode, world: str) -> None:
    began = time.process_time()
    run = NormalRun(world, seed=1)
    normal(run, mode, PART_S)
    cpu_s = time.process_time() - began
    print(
        f"\n{mode}, {world}: {run.pair.now / HOUR_S:.1f} h, {run.commands} commands, {len(run.alarms)} alarms, "
        f"{run.pair.now / cpu_s:.0f} simulated s per CPU s"
    )
    assert not run.alarms
