"""Kills processes while a car drives, and measures how long the car went on. Shared by tests/e2e and tests/soak.

Each function returns measured times and their limits. The callers judge them.
"""

import os
import random
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.support import scheduling
from tests.support.judge import Judge
from tests.support.processes import TAKEN, FleetProcesses, GatewayProcess, wait_for
from tests.support.tap import Tap

BUSY_S: Final = 4.0 if scheduling.SUITES in os.environ else 2.0
"""Time that a machine with other tests may add to a measured time: it may stall for a second, and then be slow.

`make stress` pauses cars, too. Such a car may show a stop only after the next full stop. The soak runs alone and adds
nothing.
"""
BEGINS_S: Final = 0.1
"""Maximum time from an open link to the first byte of a recovery."""
WATCHED_S: Final = 2.5
"""Time after which motors that are off stay off. It covers the longest block outside obstacle avoidance."""
OPERATOR: Final = Path(__file__).parents[1] / "e2e" / "operator_that_dies.py"


@dataclass(frozen=True, slots=True)
class Took:
    """A measured time, s, and its limit."""

    took_s: float
    limit_s: float

    @property
    def late(self) -> bool:
        """True if the time exceeds its limit."""
        return self.took_s > self.limit_s

    def __str__(self) -> str:
        return f"{self.took_s:.3f} of {self.limit_s:.2f} s"


SERVO: Final = ("servo", '{"servo": "front", "deg": 40}')
WHISTLE: Final = ("whistle", "{}")


@dataclass(frozen=True, slots=True)
class Operator:
    """A process that drives a car and is killed. `block_s`: the longest block of the car at that time."""

    car: str
    platform: str
    how: str
    watched: bool
    duration_s: float
    also: tuple[str, ...] = ()
    block_s: float = 0.0

    def __str__(self) -> str:
        also = f", {self.also[0]}" if self.also else ""
        return f"{self.platform}, {self.how} of {self.duration_s:g} s, {'token' if self.watched else 'no token'}{also}"

    def start(self, fleet: FleetProcesses) -> GatewayProcess:
        """Start the process that drives."""
        if self.how == "fleet drive":
            return fleet.start("-m", "fleet.cli", "drive", self.car, "forward", "--for", f"{self.duration_s:g}s")
        watched = "token" if self.watched else "-"
        return fleet.start(str(OPERATOR), self.car, self.how, watched, str(self.duration_s), *self.also)

    @property
    def limit_s(self) -> float:
        """Maximum time from the kill: the drive's time to live (with a token at most 1 s), the block, and 0.3 s."""
        told_s = min(self.duration_s, 1.0) if self.watched else self.duration_s
        return told_s + self.block_s + 0.3


OPERATORS: Final = (
    # A stream drives the car. Its last drive lasts for its time to live.
    Operator("a", "arduino", "stream", watched=False, duration_s=0.5),
    Operator("b", "raspberry_pi", "stream", watched=True, duration_s=10.0),
    # Front servo 0.65 s, whistle 0.3 s (docs/reference/protocol.md#blocking-times).
    Operator("c", "arduino", "stream", watched=False, duration_s=0.5, also=SERVO, block_s=0.65),
    Operator("d", "arduino", "stream", watched=True, duration_s=10.0, also=WHISTLE, block_s=0.3),
    # One command of the command line drives the car.
    Operator("e", "arduino", "command", watched=False, duration_s=1.5),
    Operator("f", "stm32", "fleet drive", watched=True, duration_s=10.0),
)


def kill_operators(
    fleet: FleetProcesses, operators: tuple[Operator, ...] = OPERATORS, world: str = "room"
) -> dict[str, Took]:
    """Kill all operators, each of which drives its own car. Return how long each car went on."""
    judges = {each.car: Judge.follow(fleet.bus, each.car) for each in operators}
    _, links = fleet.simulate(*(f"{each.car}:{each.platform}:tcp" for each in operators), truth=True, world=world)
    for each, link in zip(operators, links, strict=True):
        fleet.gateway(link, car=each.car, platform=each.platform)
    for each in operators:
        fleet.ready(each.car)
    started = {each: each.start(fleet) for each in operators}
    killed: dict[Operator, int] = {}
    # Kill first the operators whose drive ends by itself. On a machine that stalls, the drive may end before the kill.
    for each, process in sorted(started.items(), key=lambda one: one[0].how != "command"):
        if each.also or each.how == "command":
            assert process.line()["status"] in TAKEN, each
        wait_for(lambda judge=judges[each.car]: judge.on_after(0), f"{each.car} drives")
        killed[each] = process.kill()
    return {
        str(each): Took(judges[each.car].wait_off(at, watched_s=WATCHED_S), each.limit_s) for each, at in killed.items()
    }


# ---------------------------------------------------------------------- gateways


@dataclass(frozen=True, slots=True)
class Doing:
    """The state of a car whose gateway is killed, and the time of the recovery (docs/reference/protocol.md#stops)."""

    car: str
    what: str
    limit_s: float

    def begin(self, fleet: FleetProcesses, judge: Judge) -> None:
        """Bring the car to this state."""
        if self.what.startswith("driving"):
            fleet.ask("drive", self.car, motion="forward", duration_s=10)
            wait_for(lambda: judge.driving, f"{self.car} drives")
            if self.what != "driving":
                assert fleet.ask("servo", self.car, servo="front", deg=40)["status"] in TAKEN
            return
        mode = self.what.removeprefix("opening ")
        fleet.ask("mode", self.car, mode=mode)
        opening = f"$4WD,MODE{MODE_DIGITS[mode]}1#".encode()
        wait_for(lambda: opening in [data for _, _, data in judge.frames], f"{self.car} opens {mode}")
        if self.what == mode:
            wait_for(lambda: judge.modes[-1][1] == mode, f"{self.car} is in {mode}")


MODE_DIGITS: Final = {
    "tracking": 2,
    "obstacle_avoidance": 3,
    "color_led": 4,
    "light_seeking": 5,
    "following": 6,
}
# Recovery (docs/reference/protocol.md#stops): an idle car takes 0.06 s, and a report in transit 0.04 s. A busy car
# takes the rest of its block, in theory 7.3 s outside avoidance, which blocks for 4.3 s.
DOINGS: Final = (
    Doing("a", "driving", 0.1),
    Doing("b", "driving with a servo on its way", 0.65 + 0.1),
    Doing("c", "tracking", 0.1 + 0.1),
    Doing("d", "opening following", 7.3),
)
MORE_DOINGS: Final = (
    Doing("a", "following", 0.1 + 0.1),
    Doing("b", "light_seeking", 0.1 + 0.1),
    Doing("c", "color_led", 0.75 + 0.1),
    Doing("d", "obstacle_avoidance", 7.3 + 4.3),
    Doing("e", "opening tracking", 7.3),
)


def kill_gateways(fleet: FleetProcesses, doings: tuple[Doing, ...] = DOINGS) -> dict[str, Took]:
    """Kill every gateway and start new ones. Return the delay of each recovery, and how long its car goes on."""
    judges = {each.car: Judge.follow(fleet.bus, each.car) for each in doings}
    _, links = fleet.simulate(*(f"{each.car}:arduino:pty" for each in doings), truth=True)
    where = dict(zip(judges, links, strict=True))
    gateways = [fleet.gateway(link, car=car) for car, link in where.items()]
    for car in judges:
        fleet.ready(car)
    for each in sorted(doings, key=lambda doing: doing.what.startswith(("driving", "opening"))):
        each.begin(fleet, judges[each.car])
    for gateway in gateways:
        killed_ns = gateway.kill()
    wait_for(lambda: not fleet.bus.tokens("fleet/*"), "all are gone")
    assert all(judge.driving for judge, doing in zip(judges.values(), doings, strict=True) if "driving" in doing.what)
    for car, link in where.items():
        fleet.gateway(link, car=car)
    for car, judge in judges.items():
        # The first state of the new gateway: it may recover its car before the slowest gateway has started.
        said = wait_for(lambda judge=judge: judge.said_after(killed_ns), f"{car} is served again")
        assert said[0] == "unknown", car
    found = {}
    for each in doings:
        judge = judges[each.car]
        (first_s, data) = wait_for(lambda judge=judge: judge.written_after(killed_ns), f"{each} is recovered")[0]
        assert data == b"#", each
        wait_for(lambda judge=judge: judge.opened[-1] > killed_ns, f"{each}: its opening is told")
        first_ns = killed_ns + int(first_s * 1e9)
        found[f"gateway killed, {each.what}: begins"] = Took((first_ns - judge.opened[-1]) / 1e9, BEGINS_S)
        found[f"gateway killed, {each.what}: stands"] = Took(judge.wait_off(first_ns, watched_s=5.0), each.limit_s)
        fleet.ready(each.car)
        wait_for(lambda judge=judge: judge.modes[-1][1] == "manual", f"{each}: it is in mode 0")
    return found


# ---------------------------------------------------------------------- links


def cut_links(fleet: FleetProcesses, directory: Path) -> dict[str, Took]:
    """Cut the links of driving cars in three ways, and restore them. Return the times as `kill_gateways` does."""
    cuts = {"a": "pty closed", "b": "tcp reset", "c": "tcp stuck"}
    judges = {car: Judge.follow(fleet.bus, car) for car in cuts}
    sim, links = fleet.simulate(f"a:arduino:pty:{directory / 'tty'}", "b:arduino:tcp", "c:arduino:tcp", truth=True)
    reset, stuck = Tap(links[1]), Tap(links[2])
    try:
        for car, link in zip(cuts, (links[0], reset.link, stuck.link), strict=True):
            fleet.gateway(link, car=car)
        for car in cuts:
            fleet.ready(car)
        for car in cuts:
            fleet.ask("drive", car, motion="forward", duration_s=10)
            wait_for(lambda car=car: judges[car].driving, f"{car} drives")
        sim.say({"car": "a", "fault": "link_drop"})
        reset.reset()
        stuck.stall()
        for car in cuts:
            wait_for(lambda car=car: fleet.state("safety", car).motors == "unknown", f"{car} may be moving, it is said")
        assert [fleet.state("link", car).state for car in cuts] == ["lost", "lost", "stale"]
        assert all(judge.driving for judge in judges.values()), "nothing stops a car that nothing reaches"
        back_ns = time.time_ns()
        sim.say({"car": "a", "fault": "link_drop", "for_s": 0})
        reset.accept()
        stuck.flow()
        found = {}
        for car, cut in cuts.items():
            judge = judges[car]
            first_s = wait_for(
                lambda judge=judge: next((at for at, data in judge.written_after(back_ns) if data == b"#"), None),
                f"{car} is recovered",
            )
            found[f"{cut}: begins"] = Took(first_s, 1.1)  # one report a second, or one retry a second
            first_ns = back_ns + int(first_s * 1e9)
            found[f"{cut}: stands"] = Took(judge.wait_off(first_ns, watched_s=5.0), 0.1)
            fleet.ready(car)
    finally:
        reset.close()
        stuck.close()
    return found


# ---------------------------------------------------------------------- stops, in real time

STOPPED: Final = {
    "manual": "arduino",
    "tracking": "arduino",
    "obstacle_avoidance": "arduino",
    "color_led": "arduino",
    "light_seeking": "stm32",
    "following": "stm32",
    "raspberry_pi": "raspberry_pi",
}
"""Platform by mode: a car for each mode but remote_control, and a car whose program has only mode 0."""


def stop_in_every_mode(fleet: FleetProcesses, rounds: int, moments: random.Random) -> dict[str, list[Took]]:
    """Send `stop` at random moments to each car of STOPPED. Return how long motors went on, and the announced time."""
    cars = {what: f"car{number}" for number, what in enumerate(STOPPED)}
    judges = {what: Judge.follow(fleet.bus, car) for what, car in cars.items()}
    specs = (f"{car}:{STOPPED[what]}:tcp" for what, car in cars.items())
    _, links = fleet.simulate(*specs, truth=True)
    for (what, car), link in zip(cars.items(), links, strict=True):
        fleet.gateway(link, car=car, platform=STOPPED[what])
    found: dict[str, list[Took]] = {what: [] for what in cars}
    for _ in range(rounds):
        for what, car in cars.items():
            fleet.ready(car)
            if MODE_DIGITS.get(what):
                assert fleet.ask("mode", car, mode=what)["status"] in TAKEN, what
        for what, judge in judges.items():
            if MODE_DIGITS.get(what):
                wait_for(lambda judge=judge, what=what: judge.modes[-1][1] == what, f"a car is in {what}")
            else:
                fleet.ask("drive", cars[what], motion="forward", duration_s=10)
                wait_for(lambda judge=judge: judge.driving, f"{what} drives")
        time.sleep(3.6 + moments.random())  # the longest opening of a mode is over
        asked = {}
        for what, car in cars.items():
            at_ns = time.time_ns()
            answer = fleet.ask("stop", car, sender="ann", kind="person")
            assert answer["status"] in TAKEN, what
            asked[what] = at_ns, answer["worst_case_s"]
            time.sleep(moments.random() / 3)
        for what, (at_ns, worst_case_s) in asked.items():
            found[what].append(Took(judges[what].wait_off(at_ns, watched_s=5.0), worst_case_s))
            assert judges[what].modes[-1][1] == "manual", what
    return found
