"""Two sites on two machines, with certificates: red and ann here, blue and eve there, and a link that is cut.

Each side goes on by itself: its people drive and stop its cars. An e-stop holds on its own side at once, and on the
other one when the link is back. What a person of the other side drove stops. The recording of each side is whole.
"""

import signal
import time
from collections.abc import Iterator

import pytest

from tests.soak.test_several_machines import DRIVER, HEALED_S, STOPS_S
from tests.support.machines import HUB, PI, Machines, machines
from tests.support.processes import GatewayProcess, driving, wait_for

ROUNDS = 3


class TwoSites:
    """A hub, a car and a person on each of two machines."""

    def __init__(self, made: Machines) -> None:
        self.made = made
        made.make_hub("red")
        made.make_site(PI)
        for invited in (("--car", "blue"), ("eve",), ("--service", "recorder", "--site", "north")):
            made.join(PI, *invited, at="127.0.0.1")
        self.sims: dict[str, GatewayProcess] = {}
        self.at = {"red": HUB, "blue": PI}
        for car, machine in self.at.items():
            sim = self.sims[car] = made.start(
                machine, "-m", "gateway.cli", "sim", "--no-truth", "--seed", "3", "--car", f"{car}:arduino:tcp"
            )
            options = ("--car", car, "--link", sim.line()["link"], "--platform", "arduino", "--longest-drive", "60")
            made.start(machine, "-m", "gateway.cli", "run", *options, "--retry")
        self.recordings = [made.record(HUB), made.record(PI, "north")]
        self.are_linked()

    def are_linked(self) -> None:
        for machine in (HUB, PI):
            wait_for(
                lambda machine=machine: self.made.run(machine, "wait", "--ready", "red", "blue")[0] == 0,
                f"{machine} has both cars",
            )

    def drive(self, machine: str, car: str) -> GatewayProcess:
        driver = self.made.start(machine, "-c", DRIVER, car)
        driver.line()
        wait_for(lambda: self.moves(car), f"{car} drives")
        return driver

    def moves(self, car: str) -> bool:
        return driving(self.sims[car], car)


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwoSites]:
    with machines(tmp_path_factory.mktemp("sites"), 0.02, 0.02) as made:
        yield TwoSites(made)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", range(ROUNDS))
def test_partition_with_a_person_on_each_side(number: int, sites: TwoSites) -> None:
    own = sites.drive(PI, "blue")
    across = sites.drive(PI, "red")
    sites.made.cut(PI)
    began = time.monotonic()
    wait_for(lambda: not sites.moves("red"), "the car whose driver is on the other side stands")
    took = time.monotonic() - began
    assert took < STOPS_S
    assert sites.moves("blue"), "its driver is on its side"
    for machine, words in ((HUB, f"first {number}"), (PI, f"north {number}")):
        assert sites.made.run(machine, "estop", "--why", words)[0] == 0
    wait_for(lambda: not sites.moves("blue"), "blue stands")
    for process in (own, across):
        process.end(signal.SIGKILL)
    time.sleep(HEALED_S)  # not a wait: how long the link is cut
    sites.made.mend(PI)
    for car, machine in (("red", PI), ("blue", HUB)):
        for words in (f"first {number}", f"north {number}"):
            wait_for(
                lambda car=car, machine=machine, words=words: (
                    words in " ".join(sites.made.run(machine, "get", f"{car}/state/safety", "--json")[1])
                ),
                f"{car} has the e-stop of the {words}",
            )
    end = time.monotonic() + HEALED_S / 2
    while time.monotonic() < end:
        assert not any(map(sites.moves, sites.sims)), "nothing old is obeyed"
    wait_for(lambda: sites.made.run(HUB, "resume", "--all")[0] == 0, "both are free")
    sites.are_linked()
    print(f"\npartition {number}: red, driven from the other side, stood after {took:.2f} s")


@pytest.mark.soak
@pytest.mark.timeout(120)
def test_recording_of_each_site_is_whole_and_they_merge(sites: TwoSites) -> None:
    for recorder, _ in sites.recordings:
        recorder.end()
    sites.made.check_whole(*(place for _, place in sites.recordings))
