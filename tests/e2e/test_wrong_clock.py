"""A gateway whose computer's clock is minutes off: it is named, no dated command moves its car, and a stop stops it."""

import json
import re

import pytest

from schemas.commands import Verb
from tests.support.processes import FleetProcesses, GatewayProcess, driving, wait_for

A_WRONG_CLOCK = """
import sys, time
true, off_ns = time.time_ns, round(float(sys.argv.pop(1)) * 1e9)
time.time_ns = lambda: true() + off_ns
time.time = lambda: time.time_ns() / 1e9
from gateway.cli import main
main()
"""


def run(fleet: FleetProcesses, *words: str) -> tuple[int, str, str]:
    typed: GatewayProcess = fleet.start("-m", "fleet.cli", *words)
    code = typed.wait()
    return code, "\n".join(typed.lines()), typed.stderr


@pytest.mark.parametrize("off_s", [-250, 250])
def test_wrong_clock_is_reported_and_stop_still_works(fleet: FleetProcesses, off_s: int) -> None:
    sim, (red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    fleet.start("-c", A_WRONG_CLOCK, str(off_s), "run", "--car", "red", "--link", red, "--platform", "arduino")
    fleet.gateway(blue, car="blue")
    fleet.ready()
    fleet.ready("blue")
    side = "behind" if off_s < 0 else "ahead of"

    _, said, _ = run(fleet, "doctor", "--json")
    found = {car["car"]: car["findings"] for car in map(json.loads, said.splitlines())}
    causes = {(car, each["code"]): each["cause"] for car, findings in found.items() for each in findings}
    cause = causes["red", "clock_off"]
    # On a busy machine a gateway may be overloaded, too.
    assert {code for _, code in causes} <= {"clock_off", "overloaded"}, causes
    assert ("blue", "clock_off") not in causes
    assert re.search(rf"4 min (9|10|11) s {side}", cause), cause

    _, said, _ = run(fleet, "list", "--json")
    rows = {row["car"]: row for row in map(json.loads, said.splitlines())}
    assert rows["red"]["clock_off_s"] == pytest.approx(off_s, abs=2)
    assert rows["blue"]["clock_off_s"] is None
    assert not [topic for topic in rows["red"]["stale"] if topic.startswith("state/")], "only its clock is wrong"
    assert rows["red"]["ready"]
    assert off_s > 0 or "red's gateway is 4 min" in run(fleet, "list")[2]

    code, _, said = run(fleet, "drive", "red", "forward", "--for", "5s")
    assert code == 1
    assert "clock" in said
    assert not driving(sim)
    assert fleet.ask(Verb.DRIVE, motion="forward", duration_s=9.0)["status"] in ("sent", "queued"), "without a time"
    wait_for(lambda: driving(sim), "it drives")
    code, _, _ = run(fleet, "stop", "red")
    assert code == 0
    assert not driving(sim)
