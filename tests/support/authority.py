"""A person stops a car of a plan. Then the car's gateway and the coordinator are killed again and again."""

import time
from collections.abc import Sequence
from pathlib import Path

from fleet.client.client import Fleet as Client
from tests.support.judge import Judge
from tests.support.processes import FleetProcesses, GatewayProcess, wait_for

PLAN = "fixed: {red: {mode: tracking}}\n"


def want_for_ever(fleet: FleetProcesses, directory: Path, killed: Sequence[str]) -> list[float]:
    """Return the times, s after the person's stop, at which motors went on. There should be none.

    `killed`: the victims of each round.
    """
    plan = directory / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")

    def coordinate() -> GatewayProcess:
        return fleet.start("-m", "fleet.cli", "plan", "run", str(plan), "--json")

    def decided(process: GatewayProcess, mode: str | None) -> None:
        while (line := process.line())["car"] is None or line["mode"] != mode:
            pass

    judge = Judge.follow(fleet.bus)
    _, (link,) = fleet.simulate("red:arduino:pty", truth=True)
    gateway = fleet.gateway(link)
    coordinator = coordinate()
    wait_for(lambda: judge.modes and judge.modes[-1][1] == "tracking", "the coordinator has its mode")
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        person.car("red").stop().check()
    held_ns = time.time_ns()  # not the time of the newest truth: an older one may still be on its way
    for victims in killed:
        if "gateway" in victims:
            gateway.kill()
            gateway.wait()
            gateway = fleet.gateway(link)
        if "coordinator" in victims:
            coordinator.kill()
            coordinator.wait()
            coordinator = coordinate()
        fleet.ready()
        # The coordinator has decided that the held car gets no mode.
        decided(coordinator, None)
        wait_for(lambda: fleet.state("safety").HasField("hold"), "it is on hold")
        # The gateway rejects a mode of any other coordinator, too.
        answer = fleet.ask("mode", mode="tracking", kind="coordinator", sender="coordinator-x")
        assert (answer["status"], answer["reason"]) == ("rejected", "held"), answer
        assert judge.modes[-1][1] == "manual"
    moved = judge.on_after(held_ns)
    # After the end of the hold, the coordinator assigns the mode again.
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        person.car("red").resume().check()
    wait_for(lambda: judge.modes[-1][1] == "tracking", "the coordinator has its mode again")
    return moved
