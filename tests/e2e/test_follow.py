"""A plan finds the leader by light, and the other cars follow it in the simulated world. The true poses judge."""

from math import dist

import pytest

from fleet.examples import EXAMPLES
from tests.support.processes import FleetProcesses, GatewayProcess, wait_for

ROW = ("red", "green", "blue")
MODES = {"red": "light_seeking", "green": "following", "blue": "following"}


def _truth(sim: GatewayProcess) -> dict[str, tuple[str, tuple[float, float]]]:
    said = {car: sim.say({"car": car, "ask": "truth"}) for car in ROW}
    return {car: (str(each["mode"]), (float(each["x_m"]), float(each["y_m"]))) for car, each in said.items()}


@pytest.mark.soak
@pytest.mark.timeout(240)
def test_car_that_sees_lamp_leads_and_others_follow(fleet: FleetProcesses) -> None:
    sim, links = fleet.simulate(*(f"{car}:arduino:pty" for car in ROW), world=str(EXAMPLES / "worlds" / "follow.yaml"))
    for car, link in zip(ROW, links, strict=True):
        fleet.gateway(link, car=car)
    for car in ROW:
        fleet.ready(car)
    began = _truth(sim)
    coordinator = fleet.start("-m", "fleet.cli", "plan", "run", str(EXAMPLES / "plans" / "3-leader.yaml"), "--json")
    wait_for(lambda: {car: mode for car, (mode, _) in _truth(sim).items()} == MODES, "red leads, the others follow")
    roles = {role.name: list(role.cars) for role in fleet.get("fleet/@coordinator/assignment")[0].roles}
    assert roles == {"leader": ["red"], "follower": ["blue", "green"]}

    def moved() -> bool:
        return all(dist(_truth(sim)[car][1], began[car][1]) > 0.4 for car in ROW)

    wait_for(moved, "all three have moved on behind the lamp", 90.0)
    now = _truth(sim)
    assert {car: mode for car, (mode, _) in now.items()} == MODES
    for before, after in (("red", "green"), ("green", "blue")):
        assert dist(now[before][1], now[after][1]) < 0.5, "nobody is left behind"
    assert coordinator.end() == 0
