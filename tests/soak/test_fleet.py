"""Ten minutes of faults in random order, nothing added for a busy machine: `make soak` runs alone."""

import random
import time
from pathlib import Path

import pytest

from tests.support.ports import free_endpoint
from tests.support.roles import PLAN, Stage, unexplained
from tests.support.up import Up

SECONDS = 600.0
FAULTS = ("gateway", "coordinator", "hub", "link", "brownout")


@pytest.mark.soak
def test_ten_minutes_of_faults(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    seed = random.randrange(10**6)
    chance = random.Random(seed)
    with Up(tmp_path, free_endpoint(), "--sim", "8", "--plan", str(plan)) as up:
        stage = Stage(up, chance)
        stage.begin()
        print(f"\nseed {seed}\n{'fault':24} {'filled':>7} {'limit':>6} {'in force':>9}")
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            fault = stage.strike(chance.choice(FAULTS))
            if fault.filled_s is not None:
                print(f"{fault.what:24} {fault.filled_s:7.2f} {fault.limit_s:6.1f} {fault.in_force_s:9.2f}", flush=True)
            time.sleep(2 * chance.random())
        stage.judge()
        assert up.fleet("down").returncode == 0
        assert up.process.wait() == 0
    openings, missing = unexplained(up.out)
    print(f"{len(stage.faults)} faults, {openings} openings recorded, each explained")
    assert not missing
