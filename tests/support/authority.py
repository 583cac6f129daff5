"""A coordinator that wants a mode for ever, and a person who has stopped the car: both are killed, again and again."""

import time
from collections.abc import Sequence
from pathlib import Path

from fleet.client.client import Fleet as Client
from tests.support.judge import Judge
from tests.support.processes import FleetProcesses, GatewayProcess, wait_for

PLAN = "fixed: {red: {mode: tracking}}\n"


def want_for_ever(fleet: FleetProcesses, directory: Path, killed: Sequence[str]) -> list[float]:
    """When motors went on after the person's stop was complete, s: never. `killed`: what is, round by round."""
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
        assert person.car("red").stop().ok
    held_ns = time.time_ns()  # not the newest truth heard: what it did before may still be on its way
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
        # It has seen the car stand, and knows that it may not.
        decided(coordinator, None)
        wait_for(lambda: fleet.state("safety").HasField("hold"), "it is on hold")
        # Nor does it help to ask past the policy.
        answer = fleet.ask("mode", mode="tracking", kind="coordinator", sender="coordinator-x")
        assert (answer["status"], answer["reason"]) == ("rejected", "held"), answer
        assert judge.modes[-1][1] == "manual"
    moved = judge.on_after(held_ns)
    # And it would still have it: the end of the hold is all that it needs.
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        assert person.car("red").resume().ok
    wait_for(lambda: judge.modes[-1][1] == "tracking", "the coordinator has its mode again")
    return moved
