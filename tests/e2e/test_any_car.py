"""Each kind of car that people have, with real processes: usable soon, on time, and said as it is.

The simulated cars have the programs of docs/reference/protocol.md#programs-that-people-have. Their truth judges.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.kills import BUSY_S
from tests.support.ports import free_endpoint
from tests.support.processes import TAKEN, FleetProcesses, GatewayProcess, driving, wait_for

USABLE_S = 15.0
"""Maximum time from the connect until a car is ready for a command."""
MOVES_S = 0.5
"""Maximum time from the command to the motors of a car that has an echo."""


@dataclass(frozen=True)
class Kind:
    """One kind of car: the words of the simulator, the platform that the gateway is told, and what it can show."""

    name: str
    simulated: str
    told: str
    shows: str
    modes: bool = True


KINDS = (
    Kind("often", "arduino+interval=0.71", "arduino", "yes"),
    Kind("today", "arduino+interval=1.25", "arduino", "yes"),
    Kind("slow", "arduino+interval=2.2", "arduino", "yes"),
    Kind("text", "arduino+interval=1.25+text", "arduino", "yes"),
    Kind("timer", "arduino+timer+interval=1.0", "arduino", "no"),
    Kind("stm32", "stm32", "stm32", "no"),
    Kind("course", "course", "raspberry_pi+no_readings", "no", modes=False),
    Kind("silent", "arduino+interval=1.25+silent=tracking", "arduino", "yes"),
)


@dataclass
class Cars:
    """A fleet with one car of each kind, and its simulator."""

    fleet: FleetProcesses
    sim: GatewayProcess


@pytest.fixture(scope="module")
def cars(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cars]:
    """Start all cars, and wait until each is ready. It takes no longer than `USABLE_S`."""
    fleet = FleetProcesses(free_endpoint(), Path(tmp_path_factory.mktemp("cars")))
    try:
        sim, links = fleet.simulate(*(f"{kind.name}:{kind.simulated}:pty" for kind in KINDS))
        began = time.monotonic()
        for kind, link in zip(KINDS, links, strict=True):
            fleet.gateway(link, car=kind.name, platform=kind.told)
        for kind in KINDS:
            wait_for(lambda kind=kind: is_ready(fleet, kind.name), f"{kind.name} is ready")
        assert time.monotonic() - began < USABLE_S + BUSY_S
        yield Cars(fleet, sim)
    finally:
        fleet.close()


def is_ready(fleet: FleetProcesses, car: str) -> bool:
    safety = fleet.state("safety", car)
    return safety is not None and safety.trust != "unknown" and not safety.waits_for


def command(cars: Cars, *words: str) -> tuple[int, str]:
    """Run a `fleet` command. Return its exit code and its output."""
    process = cars.fleet.start("-m", "fleet.cli", *words)
    code = process.wait()
    return code, "\n".join(process.lines()) + process.stderr


each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)


@pytest.mark.xdist_group("any_car")
@each_kind
def test_a_drive_begins_at_once_and_is_said_as_it_is(cars: Cars, kind: Kind) -> None:
    asked_at = time.monotonic()
    answer = cars.fleet.ask("drive", kind.name, motion="forward", duration_s=1.0)
    assert answer["status"] in TAKEN, answer
    wait_for(lambda: driving(cars.sim, kind.name), "it drives")
    assert time.monotonic() - asked_at < MOVES_S + BUSY_S
    wait_for(lambda: not driving(cars.sim, kind.name), "it stops by itself")
    code, said = command(cars, "drive", kind.name, "forward", "--for", "300ms", "--json")
    assert code == 0, said
    outcome = json.loads(said.splitlines()[0])
    assert outcome["ok"]
    assert outcome["basis"] in ("sent", "shown")
    wait_for(lambda: not driving(cars.sim, kind.name), "it stands")


@pytest.mark.xdist_group("any_car")
@each_kind
def test_a_mode_opens_and_stays_and_a_stop_stops(cars: Cars, kind: Kind) -> None:
    if kind.modes:
        code, said = command(cars, "mode", kind.name, "tracking")
        assert code == 0, said
        wait_for(lambda: cars.sim.say({"car": kind.name, "ask": "truth"})["mode"] == "tracking", "it tracks")
        stays_until = time.monotonic() + 5.0
        wait_for(lambda: time.monotonic() > stays_until, "five seconds pass")
        assert cars.sim.say({"car": kind.name, "ask": "truth"})["mode"] == "tracking", "nothing ends it"
    code, said = command(cars, "stop", kind.name, "--json")
    outcome = json.loads(said.splitlines()[0])
    truth = cars.sim.say({"car": kind.name, "ask": "truth"})
    assert (truth["mode"], truth["motor_left"], truth["motor_right"]) == ("manual", 0, 0)
    assert code == 0, said
    assert outcome["basis"] in (("shown", "sent") if kind.shows == "yes" else ("sent", "shown"))


@pytest.mark.xdist_group("any_car")
@each_kind
def test_what_a_car_can_show_is_found_out_and_published(cars: Cars, kind: Kind) -> None:
    def found() -> str:
        return str(cars.fleet.state("health", kind.name).shows_stops)

    command(cars, "stop", kind.name)
    wait_for(lambda: found() != "not_known_yet", f"it is known what {kind.name} shows")
    assert found() == kind.shows
    code, said = command(cars, "stop", kind.name, "--json")
    assert code == 0, said
    assert json.loads(said.splitlines()[0])["basis"] == ("shown" if kind.shows == "yes" else "sent")
