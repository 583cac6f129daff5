"""E-stops, holds and leases across gateways and restarts, on real processes."""

import time

import pytest

from fleet.client.client import Fleet as Client
from tests.support.processes import TAKEN, FleetProcesses, driving, wait_for


def estops(fleet: FleetProcesses, car: str) -> list[str]:
    state = fleet.state("safety", car)
    return [] if state is None else [estop.id for estop in state.estops]


def pauses(fleet: FleetProcesses, car: str) -> list[str]:
    state = fleet.state("safety", car)
    return [] if state is None else [pause.id for pause in state.pauses]


def test_fleet_estop_and_pause_reach_all_and_outlive_gateways(
    fleet: FleetProcesses,
) -> None:
    sim, (red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    gateways = [fleet.gateway(red), fleet.gateway(blue, car="blue")]
    for car in ("red", "blue"):
        fleet.ready(car)
        assert fleet.ask("drive", car, motion="forward", duration_s=10)["status"] in TAKEN
        wait_for(lambda car=car: driving(sim, car), f"{car} drives")
    answer = fleet.ask("estop", id="e1", sender="mia", why="smoke", scope="fleet")
    assert "`fleet resume --estops`" in answer["words"]
    wait_for(lambda: estops(fleet, "blue") == ["e1"], "blue has it from red")
    wait_for(lambda: not driving(sim) and not driving(sim, "blue"), "both stand")
    assert "`fleet unpause`" in fleet.ask("pause", id="p1", sender="mia", kind="person", why="listen")["words"]
    wait_for(lambda: pauses(fleet, "blue") == ["p1"], "blue has the pause from red")

    # Green was absent. Blue's gateway is killed, and its next gateway has only the file.
    gateways[1].kill()
    _, (green,) = fleet.simulate("green:arduino:tcp")
    fleet.gateway(green, car="green")
    wait_for(lambda: estops(fleet, "green") == ["e1"], "green has it from red")
    assert fleet.state("safety", "green").hold.by == "mia"
    assert pauses(fleet, "green") == ["p1"]
    assert fleet.ask("drive", "green", motion="forward")["reason"] == "estopped"

    # E-stop and pause end while blue is away. Blue's next gateway restores both from the file, and learns of their end.
    assert fleet.ask("resume", ids=["e1"], kind="person")["status"] == "sent"
    wait_for(lambda: estops(fleet, "green") == [], "green knows of its end")
    assert fleet.ask("drive", "green", motion="forward", sender="mia")["reason"] == "paused"
    assert fleet.ask("unpause", sender="mia", kind="person")["status"] == "sent"
    wait_for(lambda: pauses(fleet, "green") == [], "green knows of the end of the pause")
    fleet.gateway(blue, car="blue")
    wait_for(lambda: fleet.state("safety", "blue") is not None, "blue is back")
    wait_for(lambda: estops(fleet, "blue") == [], "blue knows of its end")
    wait_for(lambda: pauses(fleet, "blue") == [], "blue knows of the end of the pause")
    safety = fleet.state("safety", "blue")
    assert (list(safety.ended), list(safety.ended_pauses)) == (["e1"], ["p1"])
    fleet.ready("blue")
    assert fleet.ask("drive", "blue", motion="forward")["status"] in TAKEN


def test_estop_of_all_without_id_is_one_estop(fleet: FleetProcesses) -> None:
    _, links = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp", "green:arduino:tcp")
    cars = ("red", "blue", "green")
    for car, link in zip(cars, links, strict=True):
        fleet.gateway(link, car=car)
    for car in cars:
        fleet.ready(car)
    assert len(fleet.ask_all("estop", why="smoke", scope="fleet")) == len(cars)
    wait_for(lambda: all(estops(fleet, car) for car in cars), "latched by all")
    wait_for(lambda: len({frozenset(estops(fleet, car)) for car in cars}) == 1, "the same for all")
    assert fleet.ask("resume", "blue", ids=estops(fleet, "red"), kind="person")["status"] == "sent"
    wait_for(lambda: not any(estops(fleet, car) for car in cars), "ended for all")


def test_estop_of_one_car_does_not_stop_the_others(fleet: FleetProcesses) -> None:
    _, (red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    for car, link in (("red", red), ("blue", blue)):
        fleet.gateway(link, car=car)
        fleet.ready(car)
    with Client(fleet.endpoint, sender="mia", kind="person") as client:
        (outcome,) = client.estop(["red"], "smoke")
        assert outcome.ok
        client.car("blue").drive("forward").check()
        refused = client.car("red").drive("forward")
        assert (refused.ok, refused.reason) == (False, "estopped")
        assert client.resume(["red"], estops(fleet, "red"))[0].ok
        client.car("red").drive("forward").check()


def test_next_command_line_does_not_wait_for_lease(fleet: FleetProcesses) -> None:
    _, (red,) = fleet.simulate("red:arduino:tcp")
    fleet.gateway(red)
    fleet.ready()
    holders: list[str] = []
    fleet.bus.subscribe("fleet/red/state/safety", lambda sample: holders.append(sample.message().lease.holder))  # type: ignore[attr-defined]
    for sender in ("mia-1", "mia-2", "mia-3"):
        with Client(fleet.endpoint, sender=sender, kind="person") as client:
            outcome = client.car("red").drive("forward", 0.2)
            assert outcome.ok or "stalled" in outcome.words, outcome  # the drive was taken
            wait_for(lambda sender=sender: sender in holders, "it has the lease")
        wait_for(lambda: not fleet.state("safety").HasField("lease"), "given back")


def test_stop_with_a_broken_payload_stops(fleet: FleetProcesses) -> None:
    sim, (red,) = fleet.simulate("red:arduino:tcp")
    fleet.gateway(red)
    fleet.ready()
    fleet.ask("drive", motion="forward", duration_s=10)
    wait_for(lambda: driving(sim), "it drives")
    began = time.monotonic()
    answer = fleet.ask("stop", kind="boss", sender="a/b")
    assert answer["status"] in TAKEN
    assert "stop: sender 'a/b' " in answer["words"]
    wait_for(lambda: not driving(sim), "it stands")
    assert time.monotonic() - began < 8


def test_lead_pauses_the_fleet_and_lends_a_car(fleet: FleetProcesses) -> None:
    sim, (red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    table = ("--person", "teacher:lead", "--person", "ann", "--person", "bob:other")
    fleet.gateway(red, *table)
    fleet.gateway(blue, *table, car="blue")
    with (
        Client(fleet.endpoint, person="teacher", kind="person") as teacher,
        Client(fleet.endpoint, person="ann", kind="person") as ann,
        Client(fleet.endpoint, person="bob", kind="person") as bob,
    ):
        fleet.ready("blue")
        ann.car("blue").drive("forward", 10.0, wait=False).check()
        wait_for(lambda: driving(sim, "blue"), "blue drives")
        assert [outcome.reason for outcome in ann.pause()] == ["not_allowed"] * 2
        assert driving(sim, "blue")
        assert all(outcome.ok for outcome in teacher.pause("listen"))
        wait_for(lambda: not driving(sim, "blue"), "it stands")
        assert teacher.lend(["blue"], "bob", 600.0)[0].ok
        refused = bob.car("blue").drive("forward")
        assert refused.reason == "paused"
        assert "(teacher:" in refused.words
        teacher.car("red").drive("forward", 0.2).check()
        assert [outcome.ok for outcome in teacher.unpause()] == [True] * 2
        assert ann.car("blue").drive("forward").reason == "lent"
        bob.car("blue").drive("forward").check()
        safety = fleet.state("safety", "blue")
        assert (safety.loan.to, safety.loan.rank, list(safety.pauses)) == ("bob", "lead", [])
        assert 500 < safety.loan.expires_in_s < 600
        bob.car("blue").end_loan().check()
        assert bob.car("blue").drive("forward").reason == "not_allowed"


@pytest.mark.soak
def test_gateway_without_people_learns_that_lead_ended_estop(fleet: FleetProcesses) -> None:
    _, (red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    fleet.gateway(red, "--person", "teacher:lead", "--person", "head:lead", "--person", "ann")
    fleet.gateway(blue, car="blue")
    for car in ("red", "blue"):
        fleet.ready(car)
    with (
        Client(fleet.endpoint, person="teacher", kind="person") as teacher,
        Client(fleet.endpoint, person="head", kind="person") as head,
        Client(fleet.endpoint, person="ann", kind="person") as ann,
    ):
        teacher.estop(why="smoke")
        wait_for(
            lambda: [each.rank for each in fleet.state("safety", "blue").estops] == ["lead"], "blue knows the rank"
        )
        assert [outcome.reason for outcome in ann.resume(None, everything=True)] == ["estopped"] * 2
        assert estops(fleet, "red") == estops(fleet, "blue") != []
        assert head.resume(["red"], estops(fleet, "red"))[0].ok
        wait_for(lambda: estops(fleet, "blue") == [], "blue learns the end from red")
