"""The coordinator: one more client of the bus, with a policy. Samples come in, commands and publications go out.

What it wants is decided in policy/, also that a car on hold is left alone; the gateway sees to that once more.
"""

import contextlib
import queue
import threading
import time
import traceback
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import zenoh
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.client.client import Fleet
from fleet.client.commands import led_request, mode_request
from fleet.client.outcome import Outcome
from fleet.coordinator.observer import FleetObserver
from fleet.coordinator.state_file import CoordinatorStateFile
from fleet.policy.decide import Ask, DecisionStep, step
from fleet.policy.decision import LEFT_ALONE, Decision
from fleet.policy.plan.lint import faults
from fleet.policy.plan.parser import parse
from fleet.policy.plan.plan import Plan
from fleet.policy.snapshot import CarSnapshot, Refusal, topic_of
from fleet.policy.state import PolicyState, carried, hub_back, restarted, restored, to_keep
from schemas import keys, messages, topics
from schemas.bus import BusError, Latest, Publisher, Sample, ensure_hub, reply, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos

SENDER: Final = "coordinator-"
"""How the sender of every coordinator begins, so that a second one can name the first."""
TURN_S: Final = 0.1
HUB_GONE_S: Final = 0.5
LOOK_AGAIN_S: Final = 1.0
AGAIN_S: Final = 10.0
"""Plan, assignment and decisions are published again so often, for a recording that began after them."""
_ANSWERS_S: Final = 1.0
_TRIES: Final = 3
"""How often who has just begun asks: what a car did before counts, and its gateway may be held up for a moment."""
_QUEUE: Final = 4096
_QUESTIONS: Final = 64
"""Queries that may wait in it."""
_ASKERS: Final = 4
_APIECE: Final = 8
"""Maximum cars that are asked one by one. If more came together, one question asks all cars."""
INTERNAL_ERROR: Final = "internal_error"
"""Code of the event about an exception that nobody foresaw. The coordinator goes on."""
_LONGEST_ERROR: Final = 500
"""Maximum characters of such an exception's own words: they may quote what came over the bus."""
_ERROR: Final = 4  # foxglove.Log.Level
PLAN_VERB: Final = "plan"
"""`<fleet>/@coordinator/@cmd/plan` takes another plan: a fleet.v1.Plan, or the plan's text as it is."""
RESTART_VERB: Final = "restart"
"""`<fleet>/@coordinator/@cmd/restart` begins the plan in force anew, with its first phase."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """A sample that was asked for, so it may be old."""

    sample: Sample


_Item = Sample | _Answer | zenoh.Query


class AnotherCoordinator(Exception):
    """The fleet has a coordinator; the text names it."""


@dataclass(slots=True)
class Coordinator:
    """Keeps a plan true. `client` is of kind coordinator, its sender begins with SENDER.

    `decided` hears of every decision that changed, `failed` of a command that was not carried out and of what is
    doubtful in a plan that was taken over the bus. `listed`: what the fleet file says of its cars; empty: there is
    none. Whoever gives `plan` has asked policy.check.faults() of it.
    """

    client: Fleet
    plan: Plan
    decided: Callable[[Decision], None]
    failed: Callable[[str], None]
    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    run_name: str = ""
    """Of the `fleet up` that it belongs to: with a new one the plan begins anew."""
    dropped: int = 0
    """Samples that found the queue full."""
    _memory: PolicyState = field(default_factory=PolicyState)
    _running: "dict[str, tuple[Ask, Future[list[Outcome]]]]" = field(default_factory=dict)
    _colouring: "list[tuple[Ask, Future[list[Outcome]]]]" = field(default_factory=list)
    _told: dict[str, str] = field(default_factory=dict)
    _published: dict[tuple[str, str], tuple[Publisher, Any]] = field(default_factory=dict)
    """The last of each topic, and of each subject in it: what a query is answered with."""
    _publishers: dict[str, Publisher] = field(default_factory=dict)
    _unforeseen_at: dict[str, float] = field(default_factory=dict)
    """When each unforeseen exception was logged last, by its words."""
    _subscribed: set[str] = field(default_factory=set)
    _inbox: "queue.Queue[_Item]" = field(default_factory=lambda: queue.Queue(_QUEUE))
    _questions: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(_QUESTIONS))
    """How many queries find room."""
    _tokens: Latest[bool] = field(default_factory=Latest)
    """Changes of tokens by car: True if the gateway is on the bus."""
    _came: set[str] = field(default_factory=set)
    """Cars whose gateways came and were not asked yet."""
    _asked: "list[Future[None]]" = field(default_factory=list)

    def run(self, ended: Callable[[], bool]) -> None:
        """Coordinate until `ended` says so; raises AnotherCoordinator. The cars keep their modes afterwards."""
        bus, fleet = self.client.bus, self.client.name
        token = f"{fleet}/{keys.COORDINATOR}"
        if bus.tokens(token):
            raise AnotherCoordinator(self._named(self._others()))
        bus.token(token)
        hearing = FleetObserver(self.listed)
        keeper = CoordinatorStateFile(fleet, bus.endpoint, self.run_name)
        self._subscribe(f"{fleet}/*/state/*")
        bus.watch_tokens(keys.car_token(fleet, "*"), lambda key, alive: self._tokens(key.rpartition("/")[2], alive))
        self._follow(self.plan)
        bus.queryable(f"{fleet}/{keys.COORDINATOR}/*", self._ask)
        for verb in (PLAN_VERB, RESTART_VERB):
            bus.queryable(keys.command_key(fleet, keys.COORDINATOR, verb), self._ask)
        again_at = time.monotonic() + AGAIN_S
        look_again_at: float | None = time.monotonic() + LOOK_AGAIN_S
        hubs, linked_at = bus.hubs, time.monotonic()
        with ThreadPoolExecutor(max_workers=32) as pool:
            try:
                self._listen(hearing, pool, wait_s=0.0)
                for _ in range(_TRIES):
                    self._ask_all()
                    self._listen(hearing, pool, wait_s=0.0)
                    if not hearing.unheard:
                        break
                now = time.monotonic()
                self._memory = restored(self.plan, hearing.picture(()), keeper.load(), now, time.time())
                while not ended():
                    there = bus.hubs  # before it listens: who went with the last hub has been told then
                    self._listen(hearing, pool)
                    now = time.monotonic()
                    if not there:
                        linked_at = self._see_to_hub(linked_at, now)
                        continue
                    if there != hubs:
                        hubs, self._memory = there, hub_back(self._memory, now)
                    linked_at = now
                    try:
                        self._turn(hearing, pool, now)
                    except OSError:  # its own output is gone: whoever started it has ended
                        raise
                    except Exception as error:  # noqa: BLE001 - what it decides on came over the bus
                        self._unforeseen("deciding", error)
                    keeper.save(to_keep(self.plan, self._memory, now, time.time()))
                    if look_again_at is not None and now >= look_again_at:
                        look_again_at = None
                        self._yield_to_the_first()
                    if now >= again_at:
                        again_at = now + AGAIN_S
                        for publisher, message in self._published.values():
                            publisher.put(message, time.time_ns())
            finally:
                self.client.close()  # ends what is still waited for

    # ------------------------------------------------------------------ one turn

    def _turn(self, hearing: FleetObserver, pool: ThreadPoolExecutor, now: float) -> None:
        for car, (ask, future) in list(self._running.items()):
            if future.done():
                del self._running[car]
                self._outcome(hearing, car, ask, future.result()[0], now)
        for ask, future in [each for each in self._colouring if each[1].done()]:
            self._colouring.remove((ask, future))
            outcome = future.result()[0]
            if not outcome.ok:
                self.failed(f"{ask.car}: the colour of a rule: {outcome.reason or outcome.phase}: {outcome.words}")
        hearing.forget(now, {*self.plan.named, *self._memory.held, *self._running})
        result = step(self.plan, hearing.picture(self._running), self._memory, now)
        before, self._memory = self._memory, result.memory
        self._forget(before.said.keys() - result.memory.said.keys())
        since_s = time.time() - now
        for decision in (*result.changed, *result.reworded):
            self._publish("decision", _message(decision, since_s + decision.since))
        for decision in result.changed:
            self.decided(decision)
        if result.changed or before.phase.name != result.memory.phase.name:
            self._publish("assignment", _assignment(self.plan, result))
        for ask in result.asks:
            request = mode_request(ask.mode) if ask.mode is not None else led_request(*(ask.led or (0, 0, 0)))
            future = pool.submit(self.client.ask, request, [ask.car])
            if ask.mode is not None:
                self._running[ask.car] = (ask, future)
            else:
                self._colouring.append((ask, future))

    def _forget(self, subjects: Collection[str]) -> None:
        """Nothing is decided of them any more."""
        for subject in subjects:
            self._published.pop(("decision", subject), None)
            self._told.pop(subject, None)

    def _outcome(self, hearing: FleetObserver, car: str, ask: Ask, outcome: Outcome, now: float) -> None:
        assert ask.mode is not None
        refusal = None if outcome.ok else Refusal(ask.mode, outcome.reason, outcome.words, now)
        hearing.refused(car, refusal)
        words = "" if outcome.ok else f"{car}: {outcome.reason or outcome.phase}: {outcome.words}"
        if words and words != self._told.get(car):
            self.failed(words)
        self._told[car] = words

    # ------------------------------------------------------------------ the plan

    def _follow(self, plan: Plan) -> None:
        """Hear what this plan looks at, and say that it is in force."""
        self.plan = plan
        for topic in sorted({topic_of(name) for name in plan.names}):
            if not topic.startswith("state/"):
                self._subscribe(f"{self.client.name}/*/{topic}")
        self._publish("plan", pb.Plan(text=plan.text, version=plan.version))

    def _replace(self, query: zenoh.Query, hearing: FleetObserver) -> None:
        """Take another plan, wholly; or refuse it with all that is wrong with it."""
        result = pb.Result(status="sent")
        try:
            plan = parse(_text(query))
        except (ValueError, messages.BadPayload) as error:  # BadPlan and UnicodeDecodeError are ValueErrors
            result = pb.Result(status="rejected", reason="bad_value", words=str(error))
        else:
            found = faults(plan, self.listed or None, hearing.present)
            if found.errors:
                result = pb.Result(status="rejected", reason="bad_value", words=found.refusal())
            else:
                warnings = [f"warning: {each}" for each in found.warnings]
                result.words = "\n".join((f"plan {plan.version} is in force", *warnings))
                self._take(plan)
                for each in found.warnings:
                    self.failed(f"the new plan: {each}")
        self._result(query, result)

    def _result(self, query: zenoh.Query, result: pb.Result) -> None:
        if query.parameters.get("format") == "json":
            reply(query, str(query.key_expr), messages.to_json(result).encode(), messages.JSON)
        else:
            reply(query, str(query.key_expr), result.SerializeToString(), messages.encoding_of(topics.RESULT))

    def _take(self, plan: Plan) -> None:
        self._memory = carried(self._memory, self.plan, plan)
        for name, subject in [*self._published]:
            if name == "decision":
                del self._published[name, subject]
        self._follow(plan)
        self._ask_all()

    # ------------------------------------------------------------------ what is heard

    def _subscribe(self, expression: str) -> None:
        if expression not in self._subscribed:
            self._subscribed.add(expression)
            self.client.bus.subscribe(expression, self._put)

    def _put(self, item: _Item) -> bool:
        """On a Zenoh thread; False if there is no room."""
        try:
            self._inbox.put_nowait(item)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def _ask(self, query: zenoh.Query) -> bool:
        """On a Zenoh thread; False if too many wait."""
        if not self._questions.acquire(blocking=False):
            return False
        if self._put(query):
            return True
        self._questions.release()
        return False

    def _ask_all(self, car: str = "*") -> None:
        """What the cars (or one of them) have said last: whoever begins needs not wait until they say it again."""
        wanted = {"state/*", *(topic_of(name) for name in self.plan.names)}
        for topic in sorted(wanted):
            selector = f"{self.client.name}/{car}/{topic}"
            for answer in self.client.bus.query(selector, timeout_s=_ANSWERS_S, qos=Qos.STATE):
                if isinstance(answer, Sample):
                    self._put(_Answer(answer))

    def _listen(self, hearing: FleetObserver, pool: ThreadPoolExecutor, wait_s: float = TURN_S) -> None:
        """Take what came, waiting a turn's length for the first."""
        for _ in range(_QUEUE):  # what comes meanwhile is for the next turn
            try:
                item = self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait()
            except queue.Empty:
                self._look_at_tokens(hearing, pool)
                return
            self._look_at_tokens(hearing, pool)  # first: a gateway says how its car is when its token is there
            wait_s = 0.0
            try:
                self._take_item(item, hearing)
            except OSError:  # its own output is gone: whoever started it has ended
                raise
            except Exception as error:  # noqa: BLE001 - nothing that comes over the bus may end a coordinator
                self._unforeseen("handling what came over the bus", error)

    def _take_item(self, item: _Item, hearing: FleetObserver) -> None:
        now = time.monotonic()
        if isinstance(item, zenoh.Query):
            self._questions.release()
            self._answer(item, hearing)
        elif isinstance(item, _Answer):
            hearing.take(item.sample, now, time.time())
        else:
            hearing.take(item, now, None)

    def _look_at_tokens(self, hearing: FleetObserver, pool: ThreadPoolExecutor) -> None:
        """Note who came and went, and ask who came how it is."""
        now = time.monotonic()
        for car, alive in self._tokens.taken().items():
            hearing.token(car, now, alive=alive)
            if alive and self._memory.began is not None:
                self._came.add(car)
            elif not alive:
                self._came.discard(car)
        self._asked = [each for each in self._asked if not each.done()]
        if self._came and len(self._asked) < _ASKERS:
            cars, self._came = sorted(self._came), set()
            self._asked += [pool.submit(self._ask_all, car) for car in (cars if len(cars) <= _APIECE else ["*"])]

    def _answer(self, query: zenoh.Query, hearing: FleetObserver) -> None:
        with query:
            try:
                self._reply(query, hearing)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001 - whoever asks gets an answer, and the coordinator goes on
                words = self._unforeseen(f"answering {query.key_expr}", error)
                query.reply_err(words, encoding="text/plain")

    def _reply(self, query: zenoh.Query, hearing: FleetObserver) -> None:
        if str(query.key_expr).endswith(f"/@cmd/{PLAN_VERB}"):
            self._replace(query, hearing)
            return
        if str(query.key_expr).endswith(f"/@cmd/{RESTART_VERB}"):
            self._memory = restarted(self._memory)
            self._result(query, pb.Result(status="sent", words=f"plan {self.plan.version} begins anew"))
            return
        for publisher, message in self._published.values():
            if query.key_expr.intersects(publisher.key):
                reply_value(query, publisher.key, message.SerializeToString(), publisher.topic)

    def _unforeseen(self, during: str, error: Exception) -> str:
        """Log an exception that nobody foresaw, as an event and on stderr; return the words.

        The same words are logged once in AGAIN_S: a fault in each turn would fill the disk.
        """
        frames = traceback.extract_tb(error.__traceback__)
        where = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
        words = f"{INTERNAL_ERROR} while {during}: {type(error).__name__}{where}: {str(error)[:_LONGEST_ERROR]}"
        now = time.monotonic()
        self._unforeseen_at = {each: at for each, at in self._unforeseen_at.items() if now - at < AGAIN_S}
        if words not in self._unforeseen_at:
            self._unforeseen_at[words] = now
            self._log(words)
        return words

    def _log(self, words: str) -> None:
        """Publish an error as foxglove.Log, and tell whoever started the coordinator."""
        now_ns = time.time_ns()
        message: Any = messages.message_class("foxglove.Log")(
            level=_ERROR, name=f"{keys.COORDINATOR} {INTERNAL_ERROR}", message=words
        )
        message.timestamp.seconds, message.timestamp.nanos = divmod(now_ns, 1_000_000_000)
        self._publisher("log").put(message, now_ns)
        with contextlib.suppress(Exception):  # what `failed` does is what may have failed
            self.failed(words)

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

    def _publish(self, name: str, message: Any) -> None:
        publisher = self._publisher(name)
        self._published[name, getattr(message, "subject", "")] = (publisher, message)
        publisher.put(message, time.time_ns())

    def _publisher(self, name: str) -> Publisher:
        topic = topics.TOPICS[f"{keys.COORDINATOR}/{name}"]
        if name not in self._publishers:
            key = f"{self.client.name}/{topic.name}"
            self._publishers[name] = self.client.bus.publisher(key, topic, keys.COORDINATOR)
        return self._publishers[name]


def _text(query: zenoh.Query) -> str:
    """The text of the plan that a query gives, in protobuf, in JSON, or as it is."""
    payload = query.payload.to_bytes() if query.payload is not None else b""
    encoding = str(query.encoding) if query.encoding is not None else ""
    if not encoding.startswith((topics.PROTOBUF, messages.JSON)):
        return payload.decode()
    given: Any = messages.parse(topics.TOPICS[f"{keys.COORDINATOR}/plan"].message, payload, encoding)
    return str(given.text)


def _message(decision: Decision, since_s: float) -> pb.Decision:
    return pb.Decision(
        since=Timestamp(seconds=int(since_s), nanos=int(since_s % 1 * 1e9)),
        subject=decision.subject,
        decided=decision.decided,
        why=decision.why,
        readings=decision.readings,
        would_change=decision.would_change,
        kind=decision.kind,
        role=decision.role or "",
    )


def _assignment(plan: Plan, result: DecisionStep) -> pb.Assignment:
    roles: dict[str, list[str]] = {}
    for car, role in sorted(result.roles.items()):
        roles.setdefault(role, []).append(car)
    for decision in result.decisions:
        if decision.car is not None and decision.car not in result.roles:
            roles.setdefault(decision.mode or LEFT_ALONE, []).append(decision.car)
    return pb.Assignment(
        roles=[pb.Role(name=name, cars=cars) for name, cars in sorted(roles.items())],
        phase=result.memory.phase.name,
        plan_version=plan.version,
    )
