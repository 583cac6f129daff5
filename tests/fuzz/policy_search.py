"""Searches for needless or missing decisions of a plan: random cars, faults, people and restarts of the coordinator.

Virtual time. The cars are as a coordinator sees them: each has a gateway that is slow, loses its link, is killed,
refuses modes or finds out late that its car has left its mode. The judge knows what each car really does, and what has
happened to it. `play(seed)` returns what it found.
"""

import heapq
import itertools
import random
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from msgspec.structs import replace

from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.decide import step
from fleet.policy.decision import DecisionKind
from fleet.policy.plan.plan import Plan
from fleet.policy.plan.plan_parser import parse
from fleet.policy.role_allocation import REFUSED_MODE_RETRY_S
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot, Refusal
from fleet.policy.state import FAILED_MODE_KEPT_S, PolicyState, on_hub_back, restore, to_persisted
from schemas.gen import fleet_v1_pb2 as pb
from schemas.messages import Observation
from schemas.topics import TOPICS
from schemas.words import UNKNOWN, LinkState, Mode, Motors, Reason, Verdict

TICK_S: Final = 0.25
"""Maximum time between two steps."""
FAULTS_S: Final = 90.0
CALM_S: Final = 75.0
"""Time without a fault at the end. A mode is retried after 30 s at most, and a car may lose two of these retries."""
WALL_S: Final = 1_000.0
"""Difference of the wall clock to the virtual time."""
MAX_COMMANDS: Final = 8
"""Maximum number of mode commands to a car within 30 s in which nothing happens to any car."""
STALE_S: Final = TOPICS["sensor/light"].stale_after_s or 0.0
LASTS_S: Final = 30.0
"""Time in its mode after which earlier failures of a car are forgotten."""
NOTICE_S: Final = 6.0
"""Maximum time until a gateway finds out that its car is not in its mode."""
PLANS: Final = tuple(
    parse(text)
    for text in (
        "roles: {patrol: {mode: obstacle_avoidance, count: 2}, track: {mode: tracking}}",
        "roles: {one: {mode: tracking}}",
        "roles: {first: {mode: tracking, priority: 5}, second: {mode: following}}",
        "roles: {lead: {mode: tracking, cars: [blue, red]}, rest: {mode: light_seeking, count: all}}",
        """
fixed: {green: {mode: following}}
roles: {two: {mode: tracking, count: 2, if_none: one}, one: {mode: following}}
""",
        """
roles: {pair: {mode: tracking, count: 2}}
rules: [{when: {car: red, is: light.left, for_s: 0.5}, then: {who: blue, mode: following}}]
""",
    )
)


@dataclass
class PolicyCar:
    """One car, its gateway, and what the coordinator sees of them."""

    name: str
    deaf: bool
    """True if the car ignores each mode."""
    stop_s: float
    """Time until a stop is shown."""
    report_s: float
    """Time until a reading shows a mode."""
    notice_s: float
    """Time until the gateway finds out that the car has left its mode."""
    seen: CarSnapshot = field(default_factory=CarSnapshot)
    mode: str = Mode.MANUAL
    """The mode in which the car really is."""
    down: int = 0
    """Number of reasons for which the gateway is away."""
    cut: int = 0
    """Number of reasons for which its link is lost."""
    refuses: bool = False
    opening: int = 0
    """Number of the last command. An earlier one is superseded."""
    asked: list[tuple[float, str]] = field(default_factory=list)
    is_lit: bool = False
    light: Observation | None = None
    """The last reading of the light."""
    told_since: float = 0.0
    """Since when each reading has had this value, and none was late."""
    free_since: float = 0.0
    """Since when the plan may command the car."""

    @property
    def gone(self) -> bool:
        """True if no command reaches the car."""
        return bool(self.down or self.cut)

    @property
    def able(self) -> bool:
        """True if the plan may have the car, and the car would do what it is told."""
        return not (self.deaf or self.gone or self.refuses or self.seen.taken_by or self.seen.driven_by)


@dataclass
class PolicyEpisode:
    """One fleet and its plan. `faults` has what must not happen."""

    seed: int
    faults: list[str] = field(default_factory=list)
    switches: int = 0
    commands: int = 0

    def __post_init__(self) -> None:
        self.moments = moments = random.Random(self.seed)
        self.plan: Plan = moments.choice(PLANS)
        names = ["red", "blue", "green", "white", "black"][: moments.randint(2, 5)]
        self.cars = {name: self._draw(name) for name in names}
        self.now = 0.0
        self.memory = PolicyState()
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._running = 0
        """Number of the coordinator. Outcomes of commands of an earlier one reach nobody."""
        self._hub_away = False
        self._happened_at = self._new_at = 0.0
        self._calm_commands: dict[str, list[float]] = defaultdict(list)
        for car in self.cars.values():
            self._later(moments.uniform(0.0, 1.0), self._appear, car)
            self._later(moments.uniform(0.0, 1.0), self._report, car)

    def _draw(self, name: str) -> PolicyCar:
        moments = self.moments
        return PolicyCar(
            name,
            deaf=moments.random() < 0.1,
            stop_s=moments.uniform(0.2, 5.0),
            report_s=moments.uniform(0.05, 2.8),
            notice_s=moments.uniform(0.3, NOTICE_S),
        )

    # ------------------------------------------------------------------ time

    def _later(self, delay_s: float, action: Callable[..., None], *arguments: Any) -> None:
        due = self.now + delay_s
        heapq.heappush(self._queue, (due, next(self._numbers), lambda: action(*arguments)))

    def run(self) -> None:
        """Play faults, then a calm time, and judge."""
        at = self.moments.uniform(0.0, 8.0)
        while at < FAULTS_S:
            self._later(at, self._strike)
            at += self.moments.expovariate(1 / 5.0)
        end = FAULTS_S + CALM_S
        while self.now < end and not self.faults:
            due = self._queue[0][0] if self._queue else end
            self.now = min(due, self.now + TICK_S, end)
            while self._queue and self._queue[0][0] <= self.now:
                heapq.heappop(self._queue)[2]()
            if not self._hub_away:
                self._step()
        if not self.faults:
            self._judge_use()

    # ------------------------------------------------------------------ the coordinator

    def _step(self) -> None:
        snapshot = self._snapshot()
        before = self.memory.roles
        result = step(self.plan, snapshot, self.memory, self.now)
        self.memory = result.memory
        self._judge_switches(before, self.memory.roles)
        self._judge_rule()
        for command in result.commands:
            if command.mode is None:
                continue
            car = self.cars[command.car]
            if car.seen.taken_by or car.seen.driven_by or car.seen.busy:
                self.faults.append(f"{self.now:.2f}: {car.name} is commanded, but a person has it, or it is busy")
            self.commands += 1
            self._judge_rate(car)
            car.asked.append((self.now, str(command.mode)))
            car.seen = replace(car.seen, busy=True)
            self._later(0.0005, lambda: None)  # the next step, before the gateway has the command
            self._later(self.moments.uniform(0.001, 0.02), self._accept, car, str(command.mode), self._running)

    def _snapshot(self) -> FleetSnapshot:
        readings = {name: {"sensor/light": car.light} for name, car in self.cars.items() if car.light is not None}
        return FleetSnapshot({name: car.seen for name, car in self.cars.items()}, readings)

    # ------------------------------------------------------------------ a gateway

    def _set(self, car: PolicyCar, **fields: Any) -> None:
        car.seen = replace(car.seen, **fields)

    def _appear(self, car: PolicyCar) -> None:
        """Let the gateway come up, and bring its car to rest."""
        self._set(car, present=True, link=LinkState.LOST if car.cut else LinkState.ONLINE, platform="arduino")
        self._later(self.moments.uniform(0.0, 0.2), self._publish_first, car)

    def _publish_first(self, car: PolicyCar) -> None:
        if not car.down:
            self._set(car, mode=UNKNOWN, verdict=Verdict.ASSUMED, motors=Motors.UNKNOWN)
            self._recover(car)

    def _recover(self, car: PolicyCar) -> None:
        car.opening += 1
        self._later(car.stop_s + 0.5, self._recovered, car, car.opening)

    def _recovered(self, car: PolicyCar, opening: int) -> None:
        if not car.gone and car.opening == opening:
            car.mode = Mode.MANUAL
            self._set(car, mode=Mode.MANUAL, verdict=Verdict.CONFIRMED, motors=Motors.OFF, doubted=False)

    def _accept(self, car: PolicyCar, mode: str, running: int) -> None:
        """Let a command arrive at the gateway."""
        if car.gone:
            self._end(car, mode, running, Reason.LINK_DOWN if car.seen.present else "")
        elif car.seen.taken_by or car.seen.driven_by:
            self._end(car, mode, running, Reason.HELD)
        elif car.refuses and mode != Mode.MANUAL:
            self._end(car, mode, running, Reason.BATTERY_LOW)
        else:
            car.opening += 1
            # The gateway first brings its car to rest.
            if car.seen.mode not in (Mode.MANUAL, ""):
                self._set(car, mode=Mode.MANUAL, verdict=Verdict.ASSUMED, motors=Motors.STOPPING)
                self._later(car.stop_s * self.moments.random(), self._open, car, mode, car.opening, running)
            else:
                self._open(car, mode, car.opening, running)

    def _open(self, car: PolicyCar, mode: str, opening: int, running: int) -> None:
        if car.opening != opening or car.gone:
            self._end(car, mode, running, Reason.LINK_DOWN if car.gone else "")  # superseded, or its link is lost
            return
        obeys = not car.deaf or mode == Mode.MANUAL
        car.mode = mode if obeys else car.mode
        self._set(
            car,
            mode=mode,
            verdict=Verdict.ASSUMED,
            motors=Motors.OFF if mode == Mode.MANUAL else Motors.ON,
        )
        self._end(car, mode, running, None)
        self._later(car.report_s if obeys else car.notice_s, self._show, car, mode, opening)

    def _show(self, car: PolicyCar, mode: str, opening: int) -> None:
        """Let readings show in which mode the car is."""
        if car.opening == opening and not car.gone and car.seen.mode == mode:
            if car.mode == mode:
                self._set(car, verdict=Verdict.CONFIRMED)
            else:
                self._set(car, verdict=Verdict.CONTRADICTED, motors=Motors.UNKNOWN)

    def _end(self, car: PolicyCar, mode: str, running: int, reason: str | None) -> None:
        """Let the outcome reach the coordinator that has sent the command. `reason` is None if it was carried out."""
        if running == self._running:
            refusal = None if reason is None else Refusal(mode, reason, "", self.now)
            car.seen = replace(car.seen.with_outcome(mode, refusal), busy=False)

    def _report(self, car: PolicyCar) -> None:
        """Publish a reading of the light, each second."""
        if not car.gone and not self._hub_away:
            is_late = car.light is None or self.now - car.light.at > STALE_S - TICK_S
            if is_late or car.light.message.left != car.is_lit:
                car.told_since = self.now
            car.light = Observation(pb.Light(left=car.is_lit, right=False), self.now)
        self._later(1.0, self._report, car)

    # ------------------------------------------------------------------ what happens

    def _strike(self) -> None:
        self._happened_at = self.now
        car = self.moments.choice(list(self.cars.values()))
        what = self.moments.choice(
            (self._reset, self._reset, self._drop_link, self._kill, self._empty, self._hold, self._drive, self._restart,
             self._lose_hub, self._switch_lamp, self._switch_lamp)
        )  # fmt: skip
        what(car)

    def _reset(self, car: PolicyCar) -> None:
        """Reset the car. Its gateway finds out later."""
        car.mode = Mode.MANUAL
        if not car.gone:
            self._later(car.notice_s, self._show, car, car.seen.mode, car.opening)

    def _drop_link(self, car: PolicyCar) -> None:
        if not car.down:
            car.cut += 1
            car.opening += 1
            self._set(car, link=LinkState.LOST, mode=UNKNOWN, verdict=Verdict.ASSUMED, motors=Motors.UNKNOWN)
            self._later(self.moments.choice((0.3, 1.0, 4.0, 15.0)), self._restore_link, car)

    def _restore_link(self, car: PolicyCar) -> None:
        car.cut -= 1
        if not car.gone:
            self._happen()
            self._set(car, link=LinkState.ONLINE)
            self._recover(car)

    def _kill(self, car: PolicyCar) -> None:
        """Kill the gateway. A supervisor starts another one."""
        car.down += 1
        car.opening += 1
        car.seen = CarSnapshot(busy=car.seen.busy, refused=car.seen.refused, refused_before=car.seen.refused_before)
        self._later(self.moments.uniform(0.8, 3.0), self._return, car)

    def _return(self, car: PolicyCar) -> None:
        car.down -= 1
        if not car.down:
            self._happen()
            self._appear(car)

    def _empty(self, car: PolicyCar) -> None:
        """Let the battery be critical for a while: the gateway refuses modes."""
        car.refuses = True
        self._later(self.moments.uniform(5.0, 25.0), self._charge, car)

    def _charge(self, car: PolicyCar) -> None:
        car.refuses = False
        self._happen()

    def _hold(self, car: PolicyCar) -> None:
        """Let a person stop the car, and resume it later."""
        if not car.gone and car.seen.present:
            self._take(car, self.moments.uniform(1.0, 20.0), held_by="person.ann")

    def _drive(self, car: PolicyCar) -> None:
        """Let a person drive the car for a moment."""
        if not car.gone and car.seen.present and not car.seen.taken_by:
            self._take(car, self.moments.uniform(0.5, 8.0), driven_by="person.bob")

    def _take(self, car: PolicyCar, seconds: float, **by: str) -> None:
        car.opening += 1
        car.mode = Mode.MANUAL
        self._set(car, mode=Mode.MANUAL, verdict=Verdict.CONFIRMED, motors=Motors.OFF, **by)
        self._later(seconds, self._release, car)

    def _release(self, car: PolicyCar) -> None:
        self._set(car, held_by=None, driven_by=None)
        self._happen()

    def _switch_lamp(self, _: PolicyCar) -> None:
        self.cars["red"].is_lit = not self.cars["red"].is_lit

    def _restart(self, _: PolicyCar) -> None:
        """Kill the coordinator. The next one knows what the last one has saved."""
        saved = to_persisted(self.plan, self.memory, self.now, self.now + WALL_S)
        self._running += 1
        self._new_at = self.now
        for car in self.cars.values():
            car.seen = replace(car.seen, busy=False, refused=None, refused_before=())
        self.memory = restore(self.plan, self._snapshot(), saved, self.now, self.now + WALL_S)

    def _lose_hub(self, _: PolicyCar) -> None:
        """Kill the hub. Nothing is decided until another one runs, and the gateways come back one by one."""
        if self._hub_away:
            return
        self._hub_away = True
        self._later(self.moments.uniform(0.2, 3.0), self._return_hub)

    def _return_hub(self) -> None:
        self._hub_away = False
        self._new_at = self._happened_at = self.now
        self.memory = on_hub_back(self.memory, self.now)
        for car in self.cars.values():
            if car.seen.present:
                car.seen = replace(car.seen, present=False)
                self._later(self.moments.uniform(0.0, 0.8), self._rejoin, car)

    def _rejoin(self, car: PolicyCar) -> None:
        if not car.down:  # else it comes back by itself
            car.seen = replace(car.seen, present=True)

    def _happen(self) -> None:
        self._happened_at = self.now

    # ------------------------------------------------------------------ the judge

    def _judge_switches(self, before: dict[str, str], after: dict[str, str]) -> None:
        """Find a car that has lost its role although nothing is wrong with it, and it has no other one."""
        for name, role in before.items():
            car = self.cars[name]
            if after.get(name) == role:
                continue
            self.switches += 1
            mode = str(self.plan.roles[role].mode)
            failed = [at for at, asked in car.asked if asked == mode and at > self.now - FAILED_MODE_KEPT_S - NOTICE_S]
            excused = (
                car.seen.taken_by or car.seen.driven_by
                or not car.seen.present or not car.seen.mode or car.gone
                or (car.seen.motors == Motors.UNKNOWN and car.seen.verdict != Verdict.CONTRADICTED)
                or ((refused := car.seen.refusal_of(mode)) is not None and self.now - refused.at < REFUSED_MODE_RETRY_S)
                or (car.mode != mode and len(failed) >= 2 and (len(failed) >= 3 or self.now - failed[-1] >= 1.0))
                or name in after
            )  # fmt: skip
            if not excused:
                words = f"{name} loses {role} although it is {car.mode} (asked at {failed})"
                self.faults.append(f"{self.now:.2f}: {words}: {self.memory.decisions.get(name)}")

    def _judge_rule(self) -> None:
        """Find a rule that is not in force though its condition is true, or is in force though it has been false."""
        red, blue = self.cars["red"], self.cars["blue"]
        decision = self.memory.decisions.get("blue")
        if decision is None or decision.kind is DecisionKind.ALONE:
            blue.free_since = self.now
        if not self.plan.rules or red.light is None or self.now - red.light.at > STALE_S - TICK_S:
            return
        known_s = self.now - max(red.told_since, self._new_at)
        is_on = self._is_by_rule(blue)
        lasts = known_s > 0.5 + 2 * TICK_S and self.now > blue.free_since
        if (red.light.message.left and lasts and not is_on) or (
            not red.light.message.left and known_s > HYSTERESIS_S + 2 * TICK_S and is_on
        ):
            self.faults.append(f"{self.now:.2f}: {known_s:.2f} s {red.light.message.left}, but {decision}")

    def _is_by_rule(self, car: PolicyCar) -> bool:
        """Return True if a rule decides about the car. A role is kept for it meanwhile."""
        decision = self.memory.decisions.get(car.name)
        return decision is not None and decision.kind is DecisionKind.RULE

    def _judge_rate(self, car: PolicyCar) -> None:
        if self.now - self._happened_at < LASTS_S:
            self._calm_commands.clear()
            return
        recent = [at for at in self._calm_commands[car.name] if self.now - at < LASTS_S]
        self._calm_commands[car.name] = [*recent, self.now]
        if len(recent) >= MAX_COMMANDS:
            self.faults.append(f"{self.now:.2f}: {car.name} is commanded {len(recent) + 1} times within {LASTS_S:g} s")

    def _judge_use(self) -> None:
        """Find a place that is empty after a calm time though a car is free, and a car that is not in its mode."""
        able = [car for car in self.cars.values() if car.able]
        for car in able:
            decision = self.memory.decisions.get(car.name)
            if decision is not None and decision.mode is not None and car.mode != decision.mode:
                self.faults.append(f"at the end {car.name} is in {car.mode}: {decision} {car.seen}")
        for name, role in self.plan.roles.items():
            if role.count is None or any(other.if_none == name for other in self.plan.roles.values()):
                continue
            holders = [self.cars[car] for car, held in self.memory.roles.items() if held == name]
            spare = [car.name for car in able if car.name not in self.memory.roles and self.plan.may(car.name, role)]
            missing = role.count - sum(car.able or self._is_by_rule(car) for car in holders)
            if missing > 0 and spare:
                self.faults.append(f"at the end {name} lacks {missing}, but {spare} have no role")


def play(seed: int) -> PolicyEpisode:
    """Play one episode."""
    episode = PolicyEpisode(seed)
    episode.run()
    return episode
