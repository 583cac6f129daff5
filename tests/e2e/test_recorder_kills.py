"""Kills hub and recorder under load: no message is lost without a report, and none is recorded twice.

`make soak` does the same twenty and fifty times, with more cars.
"""

import random
from pathlib import Path

import pytest

from tests.support.kills import BUSY_S
from tests.support.lossless import hub_killed, recorder_killed
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

RARELY_HZ = 5.0
"""Rate at which publishers cache fifty seconds. On a busy machine, a hub alone may take ten seconds to start."""


@pytest.mark.timeout(240)
def test_killed_hub_loses_and_duplicates_no_recorded_message(tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        for attempt in range(4):  # a kill between two publications tests nothing
            out = tmp_path / f"sessions{attempt}"
            if hub_killed(fleet, out, cars=10, times=3, chance=random.Random(6), rate_hz=RARELY_HZ).recovered:
                return
        pytest.fail("in four attempts no message was missed at first: the test tries nothing")
    finally:
        fleet.close()


@pytest.mark.timeout(240)
def test_killed_recorder_loses_last_second_which_next_one_recovers(tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        recorder_killed(fleet, tmp_path / "sessions", cars=10, times=5, chance=random.Random(7), slack_s=BUSY_S)
    finally:
        fleet.close()
