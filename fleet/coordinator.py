"""The coordinator: one more client of the bus, with a policy. Samples come in, commands and publications go out.

What it wants is decided in policy/, also that a car on hold is left alone; the gateway sees to that once more.
"""

import queue
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Final

import zenoh

from fleet.client import Fleet
from fleet.outcome import Outcome
from fleet.policy.decide import CarPicture, Decision, Picture, Seen, decide
from fleet.policy.plan import Plan
from fleet.verbs import mode_request
from schemas import keys, messages, topics
from schemas.bus import BusError, Publisher, Sample, ensure_hub, reply_value
from schemas.gen import fleet_v1_pb2 as pb

SENDER: Final = "coordinator-"
"""How the sender of every coordinator begins, so that a second one can name the first."""
TURN_S: Final = 0.1
HUB_GONE_S: Final = 0.5
LOOK_AGAIN_S: Final = 1.0
LONGEST_WAIT_S: Final = 30.0
AGAIN_S: Final = 10.0
"""Plan, assignment and decisions are published again so often, for a recording that began after them."""
_QUEUE: Final = 4096
_NEEDED: Final = ("state/link", "state/mode", "state/motion", "state/safety")

_Item = Sample | tuple[str, bool] | zenoh.Query


class AnotherCoordinator(Exception):
    """The fleet has a coordinator; the text names it."""


@dataclass(slots=True)
class _Asked:
    """What was asked of one car, and when it may be asked again."""

    attempts: int = 0
    not_before: float = 0.0
    running: "Future[list[Outcome]] | None" = None
    told: str = ""


@dataclass(slots=True)
class Coordinator:
    """Keeps the cars of a plan in their modes. `client` is of kind coordinator, its sender begins with SENDER.

    `decided` hears of every decision that changed, `failed` of a command that was not carried out.
    """

    client: Fleet
    plan: Plan
    decided: Callable[[Decision], None]
    failed: Callable[[str], None]
    dropped: int = 0
    """Samples that found the queue full."""
    _cars: dict[str, CarPicture] = field(default_factory=dict)
    _readings: dict[tuple[str, str], Seen] = field(default_factory=dict)
    _since: Mapping[int, float] = field(default_factory=dict)
    _last: dict[str, Decision] = field(default_factory=dict)
    _asked: dict[str, _Asked] = field(default_factory=dict)
    _published: dict[tuple[str, str], tuple[Publisher, Any]] = field(default_factory=dict)
    """The last of each topic, and of each car in it: what a query is answered with."""
    _inbox: "queue.Queue[_Item]" = field(default_factory=lambda: queue.Queue(_QUEUE))

    def run(self, ended: Callable[[], bool]) -> None:
        """Coordinate until `ended` says so; raises AnotherCoordinator. The cars keep their modes afterwards."""
        bus, fleet = self.client.bus, self.client.name
        token = f"{fleet}/{keys.COORDINATOR}"
        if bus.tokens(token):
            raise AnotherCoordinator(self._named(self._others()))
        bus.token(token)
        wanted = {f"{fleet}/*/state/*"} | {f"{fleet}/{rule.when.car}/{rule.when.reading}" for rule in self.plan.rules}
        for expression in sorted(wanted):
            bus.subscribe(expression, self._put)
        bus.watch_tokens(keys.car_token(fleet, "*"), lambda key, alive: self._put((key, alive)))
        publish = {name: self._publisher(name) for name in ("plan", "assignment", "decision")}
        publish["plan"](pb.Plan(text=self.plan.text, version=self.plan.version))
        bus.queryable(f"{fleet}/{keys.COORDINATOR}/*", self._put)
        again_at = time.monotonic() + AGAIN_S
        look_again_at: float | None = time.monotonic() + LOOK_AGAIN_S
        linked_at = time.monotonic()
        with ThreadPoolExecutor(max_workers=min(32, len(self.plan.cars))) as pool:
            try:
                while not ended():
                    self._drain()
                    now = time.monotonic()
                    linked_at = now if bus.connected else self._see_to_hub(linked_at, now)
                    if look_again_at is not None and now >= look_again_at:
                        look_again_at = None
                        self._yield_to_the_first()
                    self._turn(pool, publish, now)
                    if now >= again_at:
                        again_at = now + AGAIN_S
                        for publisher, message in self._published.values():
                            publisher.put(message, time.time_ns())
            finally:
                self.client.close()  # ends what is still waited for

    # ------------------------------------------------------------------ one turn

    def _turn(self, pool: ThreadPoolExecutor, publish: Mapping[str, Callable[[Any], None]], now: float) -> None:
        result = decide(self.plan, Picture(self._cars, self._readings), self._since, now)
        self._since = result.since
        changed = False
        for decision in result.decisions:
            before = self._last.get(decision.car)
            if before is None or (before.mode, before.cause) != (decision.mode, decision.cause):
                self._last[decision.car] = decision
                self._asked[decision.car] = _Asked(running=self._of(decision.car).running)
                changed = True
                publish["decision"](_message(decision))
                self.decided(decision)
            self._ask(pool, decision, now)
        if changed:
            publish["assignment"](_assignment(result.decisions))

    def _ask(self, pool: ThreadPoolExecutor, decision: Decision, now: float) -> None:
        """Ask for the mode if the car is not in it; again and again, ever more slowly."""
        asked = self._of(decision.car)
        if asked.running is not None:
            if not asked.running.done():
                return
            outcome = asked.running.result()[0]
            asked.running = None
            words = f"{decision.car}: {outcome.reason or outcome.phase}: {outcome.words}"
            if not outcome.ok and words != asked.told:
                asked.told = words
                self.failed(words)
        if not decision.ask or decision.mode is None:
            asked.attempts = 0
            return
        if now < asked.not_before:
            return
        asked.attempts += 1
        asked.not_before = now + min(LONGEST_WAIT_S, 2.0 ** (asked.attempts - 1))
        asked.running = pool.submit(self.client.ask, mode_request(decision.mode), [decision.car])

    def _of(self, car: str) -> _Asked:
        return self._asked.setdefault(car, _Asked())

    # ------------------------------------------------------------------ what is heard

    def _put(self, item: _Item) -> None:
        """On a Zenoh thread."""
        try:
            self._inbox.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _drain(self) -> None:
        """Take what came, waiting a turn's length for the first."""
        wait_s = TURN_S
        while True:
            try:
                item = self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait()
            except queue.Empty:
                return
            wait_s = 0.0
            self._take(item)

    def _take(self, item: _Item) -> None:
        if isinstance(item, zenoh.Query):
            self._answer(item)
            return
        if isinstance(item, tuple):
            car = item[0].rpartition("/")[2]
            # What was known of a car that went may no longer be so when it is back: a hold above all.
            self._cars[car] = CarPicture(present=item[1])
            for topic in _NEEDED:
                self._readings.pop((car, topic), None)
            self._asked.pop(car, None)
            return
        key = keys.parse(item.key)
        try:
            value: Any = item.message()
        except (messages.BadPayload, KeyError):
            return  # not of this fleet's gateways: nothing to decide on
        if key is None:
            return
        measured = {descriptor.name for descriptor, _ in value.ListFields()}
        fields = {
            each.name: getattr(value, each.name)
            for each in value.DESCRIPTOR.fields
            if not each.has_presence or each.name in measured
        }
        self._readings[key.car, key.topic] = Seen(fields, time.monotonic())
        self._states(key.car)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for publisher, message in self._published.values():
                if query.key_expr.intersects(publisher.key):
                    reply_value(query, publisher.key, message.SerializeToString(), publisher.topic)

    def _states(self, car: str) -> None:
        """Make the car's picture of its states: only when all that could forbid a command are known."""
        before = self._cars.get(car, CarPicture())
        states = [self._readings.get((car, topic)) for topic in _NEEDED]
        link, mode, motion, safety = states
        if not before.present or link is None or mode is None or motion is None or safety is None:
            return
        hold, lease = safety.fields.get("hold"), safety.fields.get("lease")
        estops: Any = safety.fields.get("estops") or ()
        driver = motion.fields["owner"]
        if not driver and isinstance(lease, pb.Lease) and lease.kind != "coordinator":
            driver = lease.holder
        self._cars[car] = replace(
            before,
            link=str(link.fields["state"]),
            mode=str(mode.fields["asked"]),
            verdict=str(mode.fields["verdict"]),
            held_by=hold.by if isinstance(hold, pb.Hold) else None,
            estopped_by=estops[0].by if estops else None,
            driven_by=str(driver) or None,
        )

    # ------------------------------------------------------------------ there is only one; and the hub

    def _others(self) -> list[str]:
        operators = self.client.bus.tokens(f"{self.client.name}/{keys.OPERATOR}/*")
        names = [token.rpartition("/")[2] for token in operators]
        return sorted(name for name in names if name.startswith(SENDER) and name != self.client.sender)

    def _yield_to_the_first(self) -> None:
        """Of two that started at the same moment, the one with the higher name yields."""
        others = [name for name in self._others() if name < self.client.sender]
        if others:
            raise AnotherCoordinator(self._named(others))

    def _named(self, others: list[str]) -> str:
        who = ", ".join(others) or "one that does not say who it is"
        return f"fleet {self.client.name} has a coordinator already ({who}): stop that one first"

    def _see_to_hub(self, linked_at: float, now: float) -> float:
        """Without a link for a while: see that there is a hub."""
        if now - linked_at < HUB_GONE_S:
            return linked_at
        try:
            ensure_hub(self.client.bus.endpoint)
        except BusError as error:
            self.failed(str(error))
        return now

    def _publisher(self, name: str) -> Callable[[Any], None]:
        topic = topics.TOPICS[f"{keys.COORDINATOR}/{name}"]
        publisher = self.client.bus.publisher(f"{self.client.name}/{topic.name}", topic, keys.COORDINATOR)

        def publish(message: Any) -> None:
            self._published[name, getattr(message, "subject", "")] = (publisher, message)
            publisher.put(message, time.time_ns())

        return publish


def _message(decision: Decision) -> pb.Decision:
    return pb.Decision(
        subject=decision.car,
        decided=decision.mode or "left alone",
        why=decision.why,
        readings=decision.readings,
        would_change=decision.would_change,
    )


def _assignment(decisions: tuple[Decision, ...]) -> pb.Assignment:
    roles: dict[str, list[str]] = {}
    for decision in decisions:
        roles.setdefault(decision.mode or "left alone", []).append(decision.car)
    return pb.Assignment(roles=[pb.Role(name=name, cars=cars) for name, cars in sorted(roles.items())])
