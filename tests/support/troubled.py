"""Drives and stops cars while their links fail and processes are killed, each car on its own time.

Each stop comes around one failure of the link, and nobody repeats it. The car must stand soon after the link is whole:
a stopped car is on hold, so the coordinator leaves it alone.
"""

import contextlib
import heapq
import itertools
import json
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from schemas import messages
from schemas.bus import Bus, BusError, Sample
from schemas.words import Mode
from tests.support.processes import TAKEN
from tests.support.up import Up

STANDS_S: Final = 20.0
"""Maximum time from a whole link until a stopped car stands (issue 10, in obstacle avoidance)."""
RECOVERS_S: Final = 10.0
"""Minimum time between the kill of a car's gateway and a judged stop: another gateway must come first."""
KILL_EVERY_S: Final = 25.0
FAULTS: Final[dict[str, dict[str, Any]]] = {
    "deaf": {},
    "mute": {},
    "stuck": {},
    "link_drop": {},
    "slow": {"factor": 0.1},
    "lossy": {"share": 0.3},
    "lossy a little": {"share": 0.03},
    "lossy to the car": {"share": 0.1, "to": "car"},
    "lossy to the host": {"share": 0.1, "to": "host"},
}
MODES: Final = tuple(mode.value for mode in Mode if mode is not Mode.MANUAL)


@dataclass
class Trouble:
    """Plays episodes on all cars at once. `play` returns when the time is over and each car is judged."""

    up: Up
    cars: tuple[str, ...]
    chance: random.Random
    kills: tuple[str, ...] = ("gateway", "hub", "coordinator")
    """Kinds of processes to kill now and then. Empty for none."""
    counts: Counter[str] = field(default_factory=Counter)
    driving: list[str] = field(default_factory=list)
    """Texts about cars that did not stand in time."""
    _due: list[tuple[float, int, Callable[..., object]]] = field(default_factory=list)
    _numbers: "itertools.count[int]" = field(default_factory=itertools.count)
    _killed: dict[str, float] = field(default_factory=dict)
    """Time of the last kill of each car's gateway."""
    _ends: float = 0.0

    def play(self, seconds: float) -> None:
        """Play for this time, and until the last episode is over."""
        self._ends = time.monotonic() + seconds
        for car in self.cars:
            self._after(5 * self.chance.random(), lambda car=car: self._begin(car))
        if self.kills:
            self._after(KILL_EVERY_S * self.chance.random(), self._kill)
        while self._due:
            at, _, act = heapq.heappop(self._due)
            time.sleep(max(0.0, at - time.monotonic()))
            act()

    def _after(self, seconds: float, act: Callable[..., object]) -> None:
        heapq.heappush(self._due, (time.monotonic() + seconds, next(self._numbers), act))

    def _begin(self, car: str) -> None:
        if time.monotonic() > self._ends:
            return
        chance = self.chance
        # A drive or a mode of a script ends the hold. `role`: the coordinator gives the car a role.
        load = chance.choice(["role", "rest", "drive", "drive", "steer", "mode", "mode", "mode"])
        stop_s = 1.0 + 3.0 * chance.random()
        match load:
            case "role":
                self._ask(car, "resume")
                stop_s += 4.0 * chance.random()
            case "drive":
                self._ask(car, "drive", motion="forward", duration_s=9.0)
            case "steer":
                for number in range(int(stop_s / 0.2)):
                    motion = chance.choice(["forward", "back", "spin_left", "right"])
                    self._after(0.2 * number, lambda motion=motion: self._ask(car, "drive", motion=motion))
            case "mode":
                self._ask(car, "mode", mode=chance.choice(MODES))
                stop_s += 4.0 * chance.random()
            case _:
                pass
        what = chance.choice(list(FAULTS))
        for_s = 0.3 * 20 ** chance.random()  # 0.3 to 6 s, short times as often as long ones
        fault_s = max(0.1, stop_s + chance.uniform(-min(for_s, 1.5), 0.3))
        self._after(fault_s, lambda: self._fail(car, what, for_s))
        self._after(stop_s, lambda: self._stop(car, f"{load}, {what} for {for_s:.1f} s", fault_s + for_s - stop_s))

    def _fail(self, car: str, what: str, for_s: float) -> None:
        self.counts[what] += 1
        fault = {"fault": what.split(maxsplit=1)[0], "for_s": for_s, **FAULTS[what]}
        assert self.up.simulator(car=car, **fault)["ok"]

    def _stop(self, car: str, episode: str, whole_s: float) -> None:
        taken = self._ask(car, "stop")
        self.counts["stops"] += 1
        asked_at = time.monotonic()

        def judge() -> None:
            truth = self.up.simulator(ask="truth", car=car)
            if not truth["alive"]:
                # A damaged frame kills the program of a Raspberry Pi. A person switches the car off and on.
                # See docs/reference/protocol.md#hazards-of-raspberry-pi-programs.
                self.counts["programs that died"] += 1
                for fields in (
                    {"fault": "brownout"},
                    {"fault": "link_drop", "for_s": 0.2},
                ):  # and connects its link again
                    assert self.up.simulator(car=car, **fields)["ok"]
            elif taken and self._killed.get(car, 0.0) < asked_at - RECOVERS_S:
                self.counts["stops judged"] += 1
                if truth["motor_left"] or truth["motor_right"]:
                    self.driving.append(f"{car} ({episode}), {time.monotonic() - asked_at:.0f} s after its stop")
            self._begin(car)

        self._after(max(0.0, whole_s) + STANDS_S, judge)

    def _ask(self, car: str, verb: str, **fields: Any) -> bool:
        """Send a command. Return False without an answer: the gateway may have been killed a moment ago."""
        payload = json.dumps({**fields, "sender": "soak", "kind": "script"}).encode()
        with contextlib.suppress(BusError):
            for answer in self._bus.query(
                f"fleet/{car}/@cmd/{verb}", payload=payload, encoding=messages.JSON, timeout_s=2.0
            ):
                if isinstance(answer, Sample):
                    status = json.loads(answer.payload)["status"]
                    self.counts[f"{verb} {status}"] += 1
                    return status in TAKEN
        self.counts[f"{verb} unanswered"] += 1
        return False

    @property
    def _bus(self) -> Bus:
        return self.up.bus

    def _kill(self) -> None:
        if time.monotonic() > self._ends:
            return
        what = self.chance.choice(self.kills)
        name = {"gateway": self.chance.choice(self.cars), "coordinator": "@coordinator", "hub": "@hub"}[what]
        state = None if name == "@hub" else self.up.state(name)
        pid = self.up.hub() if name == "@hub" else state.pid if state is not None else 0
        if pid:
            self.counts[f"{what} killed"] += 1
            self._killed[name] = time.monotonic()
            self.up.kill(pid)
        self._after(KILL_EVERY_S * 2 * self.chance.random(), self._kill)
