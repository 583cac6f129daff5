"""Processes that are killed while a car drives, and how long the car went on: shared by tests/e2e and tests/soak.

Nothing is judged here: each function says what was measured and what is allowed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.support.judge import Judge
from tests.support.processes import Fleet, Process, wait_for

BUSY_S: Final = 1.0
"""What a machine that runs other tests may add to a time; the soak, which runs alone, allows nothing."""
WATCHED_S: Final = 2.5
"""Motors that are off for so long stay off: the longest block after a stop that is not obstacle avoidance is over."""
OPERATOR: Final = Path(__file__).parents[1] / "e2e" / "operator_that_dies.py"


@dataclass(frozen=True, slots=True)
class Took:
    """How long a car went on, s, and how long it may."""

    took_s: float
    limit_s: float

    @property
    def late(self) -> bool:
        """Whether it went on for too long."""
        return self.took_s > self.limit_s

    def __str__(self) -> str:
        return f"{self.took_s:.3f} of {self.limit_s:.2f} s"


SERVO: Final = ("servo", '{"servo": "front", "deg": 40}')
WHISTLE: Final = ("whistle", "{}")


@dataclass(frozen=True, slots=True)
class Operator:
    """One that drives and is killed. `block_s`: what may block the car then."""

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

    def start(self, fleet: Fleet) -> Process:
        """Begin to drive."""
        if self.how == "fleet drive":
            return fleet.start("-m", "fleet.cli", "drive", self.car, "forward", "--for", f"{self.duration_s:g}s")
        watched = "token" if self.watched else "-"
        return fleet.start(str(OPERATOR), self.car, self.how, watched, str(self.duration_s), *self.also)

    @property
    def limit_s(self) -> float:
        """From the kill: its time to live, or 1 s where its token tells sooner, the block, and 0.3 s."""
        told_s = min(self.duration_s, 1.0) if self.watched else self.duration_s
        return told_s + self.block_s + 0.3


OPERATORS: Final = (
    # Driven by a stream, whose last drive holds for its time to live.
    Operator("a", "arduino", "stream", watched=False, duration_s=0.5),
    Operator("b", "raspberry_pi", "stream", watched=True, duration_s=10.0),
    # protocol.md: front servo 0.65 s, whistle 0.3 s
    Operator("c", "arduino", "stream", watched=False, duration_s=0.5, also=SERVO, block_s=0.65),
    Operator("d", "arduino", "stream", watched=True, duration_s=10.0, also=WHISTLE, block_s=0.3),
    # Driven by one command; the command line's.
    Operator("e", "arduino", "command", watched=False, duration_s=1.5),
    Operator("f", "stm32", "fleet drive", watched=True, duration_s=10.0),
)


def kill_operators(fleet: Fleet, operators: tuple[Operator, ...] = OPERATORS, world: str = "room") -> dict[str, Took]:
    """All at once, each with a car of its own: how long each car went on after its operator's death."""
    judges = {each.car: Judge.follow(fleet.bus, each.car) for each in operators}
    _, links = fleet.simulate(*(f"{each.car}:{each.platform}:tcp" for each in operators), truth=True, world=world)
    for each, link in zip(operators, links, strict=True):
        fleet.gateway(link, car=each.car, platform=each.platform)
    for each in operators:
        fleet.ready(each.car)
    started = {each: each.start(fleet) for each in operators}
    killed: dict[Operator, int] = {}
    for each, process in started.items():
        if each.also or each.how == "command":
            assert process.line()["status"] in ("sent", "queued"), each
        wait_for(lambda judge=judges[each.car]: judge.driving, f"{each.car} drives")
        killed[each] = process.kill()
    return {
        str(each): Took(judges[each.car].wait_off(at, watched_s=WATCHED_S), each.limit_s) for each, at in killed.items()
    }
