"""Judges a fleet under faults: roles are filled and in force in time, no car has two roles, no held car moves.

The simulator publishes the true states, and gateways publish written frames on frame/tx, with their own times.
"""

import random
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mcap.exceptions import McapError
from mcap.reader import make_reader

from gateway.drivers.yahboom.protocol.frames import ModeOpen, encode
from schemas import messages
from schemas.bus import Bus, Sample, sample_of
from schemas.words import Mode
from tests.support.judge import stamp_ns
from tests.support.processes import TAKEN, wait_for
from tests.support.up import Up

ROLES: Final = {"patrol": (Mode.OBSTACLE_AVOIDANCE, 3), "track": (Mode.TRACKING, 2)}
PLAN: Final = "roles:\n" + "".join(
    f"  {name}: {{mode: {mode}, count: {count}}}\n" for name, (mode, count) in ROLES.items()
)
ABLE: Final = ("red", "green", "blue", "orange", "violet", "white")
"""Cars that have modes. Two of eight simulated cars are Raspberry Pi cars without modes, so one able car is free."""
HELD: Final = "yellow"
FILL_S: Final = 3.0
"""Maximum time until another free car fills a role. If only one car can, it counts from its recovery."""
NOTICED_S: Final = 4.5
"""Maximum time to notice a reset. Three contradicting frames show a reset, one a second."""
SHOWN_S: Final = 4.0
"""Maximum time until the car has shown the stop before the next mode. Two block gaps in its reports show a stop."""
IN_FORCE_S: Final = 3.5 + 1.0
"""Maximum time from a role to its mode: the longest opening (docs/reference/protocol.md#blocking-times) and 1 s."""
STRAY_S: Final = 2.5
"""Maximum time for which motors may be on in mode 0 without a drive.

A misread MODE frame opens mode 0 for 2.3 s and keeps the motors on (docs/reference/protocol.md#hazards). Recovery stops
the motors only after that time."""
_FRAMES: Final = {encode(ModeOpen(mode)): mode for mode, _ in ROLES.values()}


@dataclass
class Watcher:
    """The true states and openings of all cars from the start. Times are ns since the epoch."""

    modes: dict[str, list[tuple[int, str]]] = field(default_factory=dict)
    """True mode by car, at each change."""
    motors: dict[str, bool] = field(default_factory=dict)
    frames: list[tuple[int, str, Mode]] = field(default_factory=list)
    """Frames to cars that open modes of the plan."""
    known: dict[str, int] = field(default_factory=dict)
    """Time of each car's last recovery to a known state."""
    twice: list[str] = field(default_factory=list)
    """Cars that had two roles in one assignment."""
    moved: list[tuple[int, str]] = field(default_factory=list)
    stray: dict[str, int] = field(default_factory=dict)
    """Time since which a car's motors are on in mode 0 without a drive."""
    strays: dict[str, float] = field(default_factory=dict)
    """Longest such time by car, s, if it is over STRAY_S."""
    _poses: dict[str, tuple[float, float]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def follow(cls, bus: Bus) -> "Watcher":
        """Subscribe to the truth, the frames, the logs and the assignments of all cars."""
        watcher = cls()
        bus.subscribe("fleet/*/sim/truth", watcher._truth)
        bus.subscribe("fleet/*/frame/tx", watcher._frame)
        bus.subscribe("fleet/*/event/log", watcher._log)
        bus.subscribe("fleet/@coordinator/assignment", watcher._assignment)
        return watcher

    def mode(self, car: str) -> str:
        """Return the car's true mode."""
        with self._lock:
            return self.modes[car][-1][1] if car in self.modes else ""

    def truly(self, mode: Mode) -> list[str]:
        """Return the cars whose true mode is this one."""
        return [car for car in ABLE if self.mode(car) == mode]

    @property
    def filled(self) -> bool:
        """True if as many cars are truly in the mode of each role as the plan demands."""
        return all(len(self.truly(mode)) == count for mode, count in ROLES.values())

    def opened_after(self, moment_ns: int, mode: Mode) -> list[tuple[int, str]]:
        """Return time and car of the openings of a mode after a moment, by frame or true mode, each car once."""
        with self._lock:
            found = {car: at for at, car, opened in reversed(self.frames) if at > moment_ns and opened is mode}
            for car in ABLE:
                for at, entered in self.modes.get(car, []):
                    if at > moment_ns and entered == mode:
                        found.setdefault(car, at)
        return sorted((at, car) for car, at in found.items())

    def entered_after(self, moment_ns: int, car: str, mode: Mode) -> int:
        """Return the time at which a car first entered a mode after a moment, 0 if not yet."""
        with self._lock:
            return next((at for at, entered in self.modes.get(car, []) if at > moment_ns and entered == mode), 0)

    def _truth(self, sample: Sample) -> None:
        truth: Any = sample.message()
        at, car, on = stamp_ns(truth), truth.car, bool(truth.motor_left or truth.motor_right)
        with self._lock:
            seen = self.modes.setdefault(car, [])
            if not seen or seen[-1][1] != truth.mode:
                seen.append((at, truth.mode))
            pose = (truth.x_m, truth.y_m)
            if self._poses.setdefault(car, pose) != pose:
                self.moved.append((at, car))
                self._poses[car] = pose
            if not on or truth.mode != "manual":
                self.stray.pop(car, None)
            elif (stray_s := (at - self.stray.setdefault(car, at)) / 1e9) > STRAY_S:
                self.strays[car] = max(stray_s, self.strays.get(car, 0.0))

    def _frame(self, sample: Sample) -> None:
        frame: Any = sample.message()
        if frame.data in _FRAMES:
            with self._lock:
                self.frames.append((stamp_ns(frame), frame.car, _FRAMES[frame.data]))

    def known_after(self, moment_ns: int, car: str, bus: Bus) -> bool:
        """Return True if a car was recovered after a moment. If the log was missed, ask the gateway."""
        if self.known.get(car, 0) <= moment_ns:
            for sample in bus.recall(f"fleet/{car}/event/log", 60.0):
                self._log(sample_of(sample))
        return self.known.get(car, 0) > moment_ns

    def _log(self, sample: Sample) -> None:
        event: Any = sample.message()
        car, _, code = event.name.partition(" ")
        if code == "recovered":
            at = event.timestamp.seconds * 1_000_000_000 + event.timestamp.nanos
            with self._lock:
                self.known[car] = max(at, self.known.get(car, 0))

    def _assignment(self, sample: Sample) -> None:
        assignment: Any = sample.message()
        cars = [car for role in assignment.roles for car in role.cars]
        self.twice += sorted({car for car in cars if cars.count(car) > 1})


@dataclass(frozen=True, slots=True)
class JudgedFault:
    """One fault and its consequences, s after the fault. None: the fault hit no car with a role."""

    what: str
    filled_s: float | None
    in_force_s: float | None
    limit_s: float

    @property
    def late(self) -> bool:
        """True if a role was filled, or in force, later than allowed."""
        if self.filled_s is None or self.in_force_s is None:
            return False
        return self.filled_s > self.limit_s or self.in_force_s > self.filled_s + IN_FORCE_S


class RoleStage:
    """A fleet with a plan, a held car, and faults one after another, each judged."""

    def __init__(self, up: Up, chance: random.Random) -> None:
        self.up = up
        self.chance = chance
        self.watcher = Watcher.follow(up.bus)
        self.faults: list[JudgedFault] = []
        self.held_ns = 0

    def begin(self) -> None:
        """Wait until all cars are known. Stop one car as a person, for a hold. Wait until the plan is in force."""
        watcher, bus = self.watcher, self.up.bus
        wait_for(lambda: all(watcher.known_after(0, car, bus) for car in (*ABLE, HELD)), "all cars are known", 90.0)
        assert self.up.ask("stop", HELD, sender="ann", kind="person")["status"] in TAKEN
        wait_for(lambda: watcher.filled, "the plan is in force", 90.0)
        self.up.ready(HELD)  # its stop may take longer than the plan
        self.held_ns = time.time_ns()

    def strike(self, what: str) -> JudgedFault:
        """Cause one fault, and wait until the fleet is whole again. Return the fault's consequences."""
        watcher = self.watcher
        car = self.chance.choice(ABLE)
        before = {mode: set(watcher.truly(mode)) for mode, _ in ROLES.values()}
        mode = next((mode for mode, cars in before.items() if car in cars), None)
        name = {"gateway": car, "coordinator": "@coordinator", "hub": "@hub"}.get(what)
        at_ns = time.time_ns()
        if name is not None:
            self._kill(name)
        else:
            fields = {"fault": "link_drop", "for_s": 4.0} if what == "link" else {"fault": "brownout"}
            assert self.up.simulator(car=car, **fields)["ok"]
        hit = name is None or name == car
        limit_s = FILL_S + (NOTICED_S + SHOWN_S if what == "brownout" else 0.0)
        filled_s = in_force_s = None
        if hit and mode is not None:
            opened = wait_for(lambda: watcher.opened_after(at_ns, mode), f"{what} {car}: {mode} is given")
            filled_s = (opened[0][0] - at_ns) / 1e9
            taken = wait_for(lambda: watcher.entered_after(at_ns, opened[0][1], mode), f"{mode} is in force")
            in_force_s = (taken - at_ns) / 1e9
        if hit and what in ("gateway", "link"):
            wait_for(lambda: watcher.known_after(at_ns, car, self.up.bus), f"{car} is known again", 60.0)
        for process in ("@hub", "@coordinator", *ABLE):
            self.up.running(process)
        wait_for(lambda: watcher.filled, "all roles are filled", 60.0)
        if not hit:
            changed = [other for opened in before for at, other in watcher.opened_after(at_ns, opened)]
            assert not changed, f"{what}: a needless switch of {changed}"
            assert before == {opened: set(watcher.truly(opened)) for opened in before}, what
        fault = JudgedFault(f"{what} {car if hit else ''}", filled_s, in_force_s, limit_s)
        self.faults.append(fault)
        return fault

    def _kill(self, name: str) -> None:
        pid = self.up.hub() if name == "@hub" else self.up.running(name)
        self.up.kill(pid)
        wait_for(lambda: not self.up.exists(pid), f"{name} is gone")

    def judge(self) -> None:
        """Fail if a car had two roles, a held car moved, motors ran in mode 0 for long, or a role was filled late."""
        watcher = self.watcher
        assert not watcher.twice, f"two roles: {watcher.twice}"
        strays = {car: stray_s for car, stray_s in watcher.strays.items() if stray_s > STRAY_S}
        assert not strays, f"motors on in mode 0 with nobody driving: {strays}"
        moved = [car for at, car in watcher.moved if car == HELD and at > self.held_ns]
        assert not moved, f"{HELD} was held and moved"
        late = [fault for fault in self.faults if fault.late and (fault.filled_s or 0) > fault.limit_s]
        assert not late, late


def unexplained(sessions: Path) -> tuple[int, list[str]]:
    """Return the number of openings in the recordings, and those that no decision and no command explains."""
    decided: dict[str, set[str]] = {}
    commands: set[str] = set()
    frames: list[tuple[str, Mode, str]] = []
    for path in sorted(sessions.glob("*/*.mcap")):
        with path.open("rb") as file:
            try:
                for schema, channel, message in make_reader(file).iter_messages():
                    if schema is None or not channel.topic.endswith(("frame/tx", "event/command", "/decision")):
                        continue
                    value: Any = messages.message_class(schema.name)()
                    value.ParseFromString(message.data)
                    if channel.topic.endswith("frame/tx") and value.data in _FRAMES:
                        frames.append((value.car, _FRAMES[value.data], value.command_id))
                    elif channel.topic.endswith("event/command") and value.verb == "mode":
                        commands.add(value.id)
                    elif channel.topic.endswith("/decision"):
                        decided.setdefault(value.subject, set()).add(value.decided)
            except McapError:
                continue
    return len(frames), [
        f"{car} {mode}" for car, mode, command in frames if command not in commands or mode not in decided.get(car, ())
    ]
