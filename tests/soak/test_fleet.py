"""Ten minutes of faults in random order, with strict limits: `make soak` runs alone.

`FLEET_SOAK_S=120` plays for a shorter time, `FLEET_SOAK_SEED=7` repeats the choices of a run.
"""

import os
import random
import time
from pathlib import Path

import pytest

from fleet.supervisor.spec import SIMULATED_CAR_NAMES
from tests.support.claims import KINDS, Claims
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for
from tests.support.roles import PLAN, RoleStage, unexplained
from tests.support.troubled import Trouble
from tests.support.up import Up

SECONDS = float(os.environ.get("FLEET_SOAK_S", "600"))
SEED = int(os.environ.get("FLEET_SOAK_SEED", random.randrange(10**6)))
CARS = SIMULATED_CAR_NAMES[:8]
FAULTS = ("gateway", "coordinator", "hub", "link", "brownout")


@pytest.mark.soak
def test_ten_minutes_of_faults(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    chance = random.Random(SEED)
    with Up(tmp_path, free_endpoint(), "--sim", "8", "--plan", str(plan)) as up:
        claims = Claims.follow(up.bus)
        stage = RoleStage(up, chance)
        stage.begin()
        print(f"\nseed {SEED}\n{'fault':24} {'filled':>7} {'limit':>6} {'in force':>9}")
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            fault = stage.strike(chance.choice(FAULTS))
            if fault.filled_s is not None:
                print(f"{fault.what:24} {fault.filled_s:7.2f} {fault.limit_s:6.1f} {fault.in_force_s:9.2f}", flush=True)
            time.sleep(2 * chance.random())
        stage.judge()
        print(claims)
        assert up.fleet("down").returncode == 0
        assert up.process.wait() == 0
    openings, missing = unexplained(up.out)
    print(f"{len(stage.faults)} faults, {openings} openings recorded, each explained")
    assert not missing
    assert not _false(claims)


@pytest.mark.soak
def test_ten_minutes_of_links_that_fail_around_stops(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    with Up(tmp_path, free_endpoint(), "--sim", "8", "--plan", str(plan)) as up:
        claims = Claims.follow(up.bus)
        for car in CARS:  # the plan may drive a car as soon as its state is known
            wait_for(
                lambda car=car: (
                    (safety := up.get(f"{car}/state/safety")) and safety.trust not in ("unknown", "recovering")
                ),
                f"{car} is known",
                90.0,
            )
        trouble = Trouble(up, CARS, random.Random(SEED))
        trouble.play(SECONDS)
        print(f"\nseed {SEED}: " + ", ".join(f"{count} {what}" for what, count in sorted(trouble.counts.items())))
        print(f"{claims}\n{len(trouble.driving):4} cars that did not stand in time")
        down = up.fleet("down")
        assert down.returncode == 0, f"{down.stdout}{down.stderr}"
        assert up.process.wait() == 0
    assert not trouble.driving
    assert not _false(claims)


def _false(claims: Claims) -> list[str]:
    found = claims.false()
    return [f"{kind}: {each}" for kind in KINDS for each in found[kind]]
