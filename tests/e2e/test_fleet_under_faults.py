"""A minute of what tests/soak/test_fleet.py does for ten: faults one after another, every role filled again in time."""

import random
from pathlib import Path

import pytest

from tests.support.ports import free_endpoint
from tests.support.roles import PLAN, RoleStage, unexplained
from tests.support.up import Up


@pytest.mark.xdist_group("up")
@pytest.mark.timeout(300)
def test_a_plan_survives_faults(tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    with Up(tmp_path, free_endpoint(), "--sim", "8", "--plan", str(plan)) as up:
        stage = RoleStage(up, random.Random(5))
        stage.begin()
        for what in ("coordinator", "gateway", "hub", "link", "brownout"):
            stage.strike(what)
        stage.judge(slack_s=5.0)  # other tests run beside this one
        assert up.fleet("down").returncode == 0
        assert up.process.wait() == 0
        up.until("process", "@recorder", "recording closed")
    openings, missing = unexplained(up.out)
    assert openings >= 5
    assert not missing
