"""The coordinator: a client of the bus with a policy. Samples come in, commands and publications go out.

policy/ takes all decisions, also to leave a car on hold alone; the gateway enforces that once more.
"""

import contextlib
import queue
import threading
import time
import traceback
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
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
from fleet.policy.plan.lint import find_faults
from fleet.policy.plan.parser import parse
from fleet.policy.plan.plan import Plan
from fleet.policy.requests import EVENTS, PlanRequest, RequestRefused, check_sender, on_request
from fleet.policy.snapshot import CarSnapshot, Refusal, topic_of
from fleet.policy.state import PolicyState, carry_over, on_hub_back, restore, to_persisted
from schemas import keys, messages, topics
from schemas.authority import People
from schemas.bus import HubKeeper, Latest, Publisher, Sample, reply_message, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from schemas.process.suspend import MONOTONIC_COUNTS_SLEEP, SleepWatch, clock_pair
from schemas.topics import Qos
from schemas.words import Level, Phase, Reason

SENDER: Final = "coordinator-"
"""Prefix of every coordinator's sender name, so that a second coordinator can name the first."""
STEP_INTERVAL_S: Final = 0.1
HUB_OUTAGE_S: Final = 0.5
"""Time without a link to a hub after which the coordinator starts one."""
SINGLETON_RECHECK_S: Final = 1.0
"""Delay of the second search for other coordinators: two may have started at the same moment."""
REPUBLISH_INTERVAL_S: Final = 10.0
"""Interval of repeated plans, assignments and decisions, for recordings that began after the first."""
_STATE_QUERY_TIMEOUT_S: Final = 1.0
_MAX_STATE_QUERIES: Final = 3
"""Maximum queries for the cars' states at the start: a stalled gateway may miss the first."""
_INBOX_SIZE: Final = 4096
_MAX_WAITING_QUERIES: Final = 64
"""Maximum queries in the inbox."""
_MAX_STATE_QUERIES_AT_ONCE: Final = 4
_MAX_CARS_QUERIED_SINGLY: Final = 8
"""Maximum cars with a query of their own. If more arrive together, one query asks all cars."""
INTERNAL_ERROR: Final = "internal_error"
"""Code of the event about an unexpected exception. The coordinator goes on."""
_MAX_ERROR_LENGTH: Final = 500
"""Maximum characters of such an exception's text, which may quote payloads from the bus."""
PLAN_VERB: Final = "plan"
"""`<fleet>/@coordinator/@cmd/plan` takes another plan: a fleet.v1.Plan, or the plan's text as it is."""
_ANONYMOUS: Final = "anonymous"
_PLAN_SET: Final = "plan_set"
_UNSAVED: Final = "It cannot be saved: a restarted coordinator will not know it."


@dataclass(frozen=True, slots=True)
class _QueriedSample:
    """A sample from a query, so it may be old."""

    sample: Sample


_Item = Sample | _QueriedSample | zenoh.Query


class AnotherCoordinator(Exception):
    """The fleet has a coordinator already; the text names it."""


@dataclass(slots=True)
class Coordinator:
    """Commands cars by a plan. `client` is of kind coordinator, its sender begins with SENDER.

    The coordinator calls `on_decision` for each changed decision, and `on_failure` for each failed command and each
    warning about a plan from the bus. `listed`: the cars of the fleet file; empty: there is none. The caller has
    checked `plan` by lint.find_faults().
    """

    client: Fleet
    plan: Plan
    on_decision: Callable[[Decision], None]
    on_failure: Callable[[str], None]
    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    people: People | None = None
    """The people of the fleet file, who may change the plan. None: those that the gateways know."""
    run_name: str = ""
    """Name of its `fleet up` run: in a new run the plan begins anew."""
    sleep: SleepWatch = field(default_factory=lambda: SleepWatch(clock_pair()))
    dropped: int = 0
    """Number of samples and queries dropped because the inbox was full."""
    _memory: PolicyState = field(default_factory=PolicyState)
    _state_file: CoordinatorStateFile | None = None
    _restored: bool = False
    """True once the persisted state is restored."""
    _early: list[zenoh.Query] = field(default_factory=list)
    """Commands that came before that."""
    _mode_commands: "dict[str, tuple[Ask, Future[list[Outcome]]]]" = field(default_factory=dict)
    _led_commands: "list[tuple[Ask, Future[list[Outcome]]]]" = field(default_factory=list)
    _last_failures: dict[str, str] = field(default_factory=dict)
    _published: dict[tuple[str, str], tuple[Publisher, Any]] = field(default_factory=dict)
    """The last message by topic and subject: the replies to queries."""
    _publishers: dict[str, Publisher] = field(default_factory=dict)
    _internal_errors: dict[str, float] = field(default_factory=dict)
    """Time at which each unexpected exception was logged last, by its words."""
    _subscribed: set[str] = field(default_factory=set)
    _inbox: "queue.Queue[_Item]" = field(default_factory=lambda: queue.Queue(_INBOX_SIZE))
    _query_slots: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(_MAX_WAITING_QUERIES))
    """Free places for queries in the inbox."""
    _tokens: Latest[bool] = field(default_factory=Latest)
    """Changes of tokens by car: True if the gateway is on the bus."""
    _arrived: set[str] = field(default_factory=set)
    """Cars whose gateways arrived and whose states were not queried yet."""
    _state_queries: "list[Future[None]]" = field(default_factory=list)

    def run(self, has_ended: Callable[[], bool]) -> None:
        """Coordinate until `has_ended()`; raises AnotherCoordinator. The cars keep their modes afterwards."""
        bus, fleet = self.client.bus, self.client.name
        token = f"{fleet}/{keys.COORDINATOR}"
        if bus.tokens(token):
            raise AnotherCoordinator(self._describe(self._others()))
        bus.token(token)
        observer = FleetObserver(self.listed)
        state_file = self._state_file = CoordinatorStateFile(fleet, bus.endpoint, self.run_name)
        self._subscribe(f"{fleet}/*/state/*")
        bus.watch_tokens(keys.car_token(fleet, "*"), lambda key, alive: self._tokens(key.rpartition("/")[2], alive))
        self._put_in_force(self.plan)
        bus.queryable(f"{fleet}/{keys.COORDINATOR}/*", self._on_query)
        for verb in (PLAN_VERB, *PlanRequest):
            bus.queryable(keys.command_key(fleet, keys.COORDINATOR, verb), self._on_query)
        republish_at = time.monotonic() + REPUBLISH_INTERVAL_S
        recheck_at: float | None = time.monotonic() + SINGLETON_RECHECK_S
        hubs, hub_keeper = bus.hubs, HubKeeper(bus.endpoint, HUB_OUTAGE_S, self.on_failure)
        with ThreadPoolExecutor(max_workers=32) as pool:
            try:
                self._drain_inbox(observer, pool, wait_s=0.0)
                for _ in range(_MAX_STATE_QUERIES):
                    self._query_states()
                    self._drain_inbox(observer, pool, wait_s=0.0)
                    if not observer.unconfirmed:
                        break
                now = time.monotonic()
                self._memory = restore(self.plan, observer.snapshot(()), state_file.load(), now, time.time())
                self._restored = True
                for query in self._early:
                    self._answer(query, observer)
                while not has_ended():
                    # Read the hubs before the inbox, which then has the lost tokens of a hub that is gone.
                    linked_hubs = bus.hubs
                    self._drain_inbox(observer, pool)
                    now = time.monotonic()
                    self._check_sleep(observer, now)
                    hub_keeper.check(connected=bool(linked_hubs))
                    if not linked_hubs:
                        continue
                    if linked_hubs != hubs:
                        hubs, self._memory = linked_hubs, on_hub_back(self._memory, now)
                    try:
                        self._step(observer, pool, now)
                    except OSError:  # its own output is closed: its parent has ended
                        raise
                    except Exception as error:  # noqa: BLE001 - the input came over the bus
                        self._log_internal_error("deciding", error)
                    if recheck_at is not None and now >= recheck_at:
                        recheck_at = None
                        self._yield_to_another()
                    if now >= republish_at:
                        republish_at = now + REPUBLISH_INTERVAL_S
                        for publisher, message in self._published.values():
                            publisher.put(message, time.time_ns())
                if not self.run_name and self._memory.stopped_by:
                    # Who ends a coordinator by hand and starts another one wants its plan to run.
                    self._save(replace(self._memory, stopped_by="", to_rest=frozenset()))
            finally:
                self.client.close()  # ends pending commands

    def _check_sleep(self, observer: FleetObserver, now: float) -> None:
        """After a sleep of the computer, decide by new readings only. The sleep costs no car its role."""
        if (slept_s := self.sleep.take()) > 0:
            observer.on_sleep(0.0 if MONOTONIC_COUNTS_SLEEP else slept_s)
            self._memory = on_hub_back(self._memory, now)

    # ------------------------------------------------------------------ one step

    def _step(self, observer: FleetObserver, pool: ThreadPoolExecutor, now: float) -> None:
        for car, (ask, future) in list(self._mode_commands.items()):
            if future.done():
                del self._mode_commands[car]
                self._on_outcome(observer, car, ask, future.result()[0], now)
        for ask, future in [each for each in self._led_commands if each[1].done()]:
            self._led_commands.remove((ask, future))
            outcome = future.result()[0]
            words = (
                ""
                if outcome.ok
                else f"{ask.car}: the color of a rule: {outcome.reason or outcome.phase}: {outcome.words}"
            )
            if words and words != self._last_failures.get(f"{ask.car} led"):  # a blinking LED fails every second
                self.on_failure(words)
            self._last_failures[f"{ask.car} led"] = words
        observer.forget(now, {*self.plan.named, *self._memory.held_roles, *self._mode_commands})
        result = step(self.plan, observer.snapshot(self._mode_commands), self._memory, now)
        before, self._memory = self._memory, result.memory
        # Persist before anything is published or commanded: a coordinator killed now is followed by one that knows.
        self._save(self._memory)
        self._forget(before.decisions.keys() - result.memory.decisions.keys())
        since_s = time.time() - now
        for decision in (*result.changed, *result.reworded):
            self._publish("decision", _message(decision, since_s + decision.since))
        for decision in result.changed:
            self.on_decision(decision)
        if result.changed or _in_force(before) != _in_force(result.memory):
            self._publish("assignment", _assignment(self.plan, result))
        for ask in result.asks:
            if ask.blink and any(ask.car == other.car for other, _ in self._led_commands):
                continue  # its link or the car is slower than the LED should blink
            request = mode_request(ask.mode) if ask.mode is not None else led_request(*(ask.led or (0, 0, 0)))
            future = pool.submit(self.client.ask, request, [ask.car])
            if ask.mode is not None:
                self._mode_commands[ask.car] = (ask, future)
            else:
                self._led_commands.append((ask, future))

    def _forget(self, subjects: Collection[str]) -> None:
        """Forget subjects that have no decision any more."""
        for subject in subjects:
            self._published.pop(("decision", subject), None)
            self._last_failures.pop(subject, None)
            self._last_failures.pop(f"{subject} led", None)

    def _on_outcome(self, observer: FleetObserver, car: str, ask: Ask, outcome: Outcome, now: float) -> None:
        assert ask.mode is not None
        refusal = None if outcome.ok else Refusal(ask.mode, outcome.reason, outcome.words, now)
        observer.on_outcome(car, refusal)
        words = "" if outcome.ok else f"{car}: {outcome.reason or outcome.phase}: {outcome.words}"
        if words and words != self._last_failures.get(car):
            self.on_failure(words)
        self._last_failures[car] = words

    # ------------------------------------------------------------------ the plan

    def _save(self, memory: PolicyState) -> bool:
        """Persist the state. Return False if it cannot be written."""
        assert self._state_file is not None
        return self._state_file.save(to_persisted(self.plan, memory, time.monotonic(), time.time()))

    def _check_sender(self, observer: FleetObserver, by: str) -> None:
        check_sender(observer.people if self.people is None else self.people, by)

    def _on_request(self, query: zenoh.Query, request: PlanRequest, observer: FleetObserver) -> None:
        """Carry out a request for the plan in force. It is persisted and recorded before it is confirmed."""
        try:
            by = _sender(query, "fleet.v1.PlanCommand")
            self._check_sender(observer, by)
            memory, words = on_request(request, self.plan, self._memory, by, time.monotonic())
        except RequestRefused as refused:
            self._reply_result(query, _rejected(refused))
            return
        except messages.BadPayload as error:
            self._reply_result(
                query, pb.Result(status=Phase.REJECTED, reason=Reason.BAD_VALUE, words=f"{error} [bad_value]")
            )
            return
        if request is not PlanRequest.NEXT and memory is not self._memory:
            self._drop_decisions()
        self._memory = memory
        saved = self._save(memory)
        code, did = EVENTS[request]
        self._log(Level.INFO, code, f"{keys.name_of(by)} {did} ({words})")
        self._reply_result(query, pb.Result(status=Phase.SENT, words=words if saved else f"{words}. {_UNSAVED}"))

    def _drop_decisions(self) -> None:
        for name, subject in [*self._published]:
            if name == "decision":
                del self._published[name, subject]

    def _put_in_force(self, plan: Plan, set_by: str = "") -> None:
        """Put a plan in force: subscribe to the readings that it uses, and publish it."""
        self.plan = plan
        for topic in sorted({topic_of(name) for name in plan.names}):
            if not topic.startswith("state/"):
                self._subscribe(f"{self.client.name}/*/{topic}")
        self._publish("plan", pb.Plan(text=plan.text, version=plan.version, set_by=set_by))

    def _on_plan(self, query: zenoh.Query, observer: FleetObserver) -> None:
        """Put the plan of a query in force, or refuse it with all its faults."""
        result = pb.Result(status=Phase.SENT)
        try:
            text, by = _plan_command(query)
            self._check_sender(observer, by)
            plan = parse(text)
        except RequestRefused as refused:
            result = _rejected(refused)
        except (ValueError, messages.BadPayload) as error:  # BadPlan and UnicodeDecodeError are ValueErrors
            result = pb.Result(status=Phase.REJECTED, reason=Reason.BAD_VALUE, words=str(error))
        else:
            plan_faults = find_faults(plan, self.listed or None, observer.present)
            if plan_faults.errors:
                result = pb.Result(status=Phase.REJECTED, reason=Reason.BAD_VALUE, words=plan_faults.refusal())
            else:
                warnings = [f"warning: {each}" for each in plan_faults.warnings]
                result.words = "\n".join((f"plan {plan.version} is in force", *warnings))
                self._take_over(plan, by)
                for each in plan_faults.warnings:
                    self.on_failure(f"the new plan: {each}")
        self._reply_result(query, result)

    def _reply_result(self, query: zenoh.Query, result: pb.Result) -> None:
        reply_message(query, str(query.key_expr), result, as_json=query.parameters.get("format") == "json")

    def _take_over(self, plan: Plan, by: str) -> None:
        self._memory = carry_over(self._memory, self.plan, plan)
        self._drop_decisions()
        self._put_in_force(plan, by)
        self._save(self._memory)
        self._log(Level.INFO, _PLAN_SET, f"{keys.name_of(by)} put plan {plan.version} in force")
        self._query_states()

    # ------------------------------------------------------------------ samples and queries

    def _subscribe(self, expression: str) -> None:
        if expression not in self._subscribed:
            self._subscribed.add(expression)
            self.client.bus.subscribe(expression, self._enqueue)

    def _enqueue(self, item: _Item) -> bool:
        """Put an item into the inbox; False if it is full. Runs on a Zenoh thread."""
        try:
            self._inbox.put_nowait(item)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def _on_query(self, query: zenoh.Query) -> bool:
        """Put a query into the inbox; False if too many wait. Runs on a Zenoh thread."""
        if not self._query_slots.acquire(blocking=False):
            return False
        if self._enqueue(query):
            return True
        self._query_slots.release()
        return False

    def _query_states(self, car: str = "*") -> None:
        """Query the last states and readings of all cars, or of one."""
        topics_wanted = {"state/*", *(topic_of(name) for name in self.plan.names)}
        for topic in sorted(topics_wanted):
            selector = f"{self.client.name}/{car}/{topic}"
            for answer in self.client.bus.query(selector, timeout_s=_STATE_QUERY_TIMEOUT_S, qos=Qos.STATE):
                if isinstance(answer, Sample):
                    self._enqueue(_QueriedSample(answer))

    def _drain_inbox(self, observer: FleetObserver, pool: ThreadPoolExecutor, wait_s: float = STEP_INTERVAL_S) -> None:
        """Handle all items in the inbox. Wait at most `wait_s` for the first."""
        for _ in range(_INBOX_SIZE):  # later items are for the next step
            try:
                item = self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait()
            except queue.Empty:
                self._handle_tokens(observer, pool)
                return
            self._handle_tokens(observer, pool)  # first: a gateway declares its token before it publishes states
            wait_s = 0.0
            try:
                self._handle(item, observer)
            except OSError:  # its own output is closed: its parent has ended
                raise
            except Exception as error:  # noqa: BLE001 - no input from the bus may end a coordinator
                self._log_internal_error("handling what came over the bus", error)

    def _handle(self, item: _Item, observer: FleetObserver) -> None:
        now = time.monotonic()
        if isinstance(item, zenoh.Query):
            self._query_slots.release()
            if not self._restored and "/@cmd/" in str(item.key_expr):
                self._early.append(item)
            else:
                self._answer(item, observer)
        elif isinstance(item, _QueriedSample):
            observer.on_sample(item.sample, now, time.time())
        else:
            observer.on_sample(item, now, None)

    def _handle_tokens(self, observer: FleetObserver, pool: ThreadPoolExecutor) -> None:
        """Note arrived and lost gateways, and query the states of those that arrived."""
        now = time.monotonic()
        for car, alive in self._tokens.take().items():
            observer.on_token(car, now, alive=alive)
            if alive and self._memory.started_at is not None:
                self._arrived.add(car)
            elif not alive:
                self._arrived.discard(car)
        self._state_queries = [each for each in self._state_queries if not each.done()]
        if self._arrived and len(self._state_queries) < _MAX_STATE_QUERIES_AT_ONCE:
            cars, self._arrived = sorted(self._arrived), set()
            self._state_queries += [
                pool.submit(self._query_states, car)
                for car in (cars if len(cars) <= _MAX_CARS_QUERIED_SINGLY else ["*"])
            ]

    def _answer(self, query: zenoh.Query, observer: FleetObserver) -> None:
        with query:
            try:
                self._reply(query, observer)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001 - each query gets a reply, and the coordinator goes on
                words = self._log_internal_error(f"answering {query.key_expr}", error)
                query.reply_err(words, encoding="text/plain")

    def _reply(self, query: zenoh.Query, observer: FleetObserver) -> None:
        begin, _, verb = str(query.key_expr).rpartition("/")
        if begin.endswith("/@cmd"):
            if "*" in verb:
                query.reply_err(f"{query.key_expr}: name the command", encoding="text/plain")
            elif verb == PLAN_VERB:
                self._on_plan(query, observer)
            else:
                self._on_request(query, PlanRequest(verb), observer)
            return
        for publisher, message in self._published.values():
            if query.key_expr.intersects(publisher.key):
                reply_value(query, publisher.key, message.SerializeToString(), publisher.topic)

    def _log_internal_error(self, during: str, error: Exception) -> str:
        """Log an unexpected exception as an event and on stderr; return the words.

        The same words are logged once per REPUBLISH_INTERVAL_S: a fault in each step would fill the disk.
        """
        frames = traceback.extract_tb(error.__traceback__)
        where = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
        words = f"{INTERNAL_ERROR} while {during}: {type(error).__name__}{where}: {str(error)[:_MAX_ERROR_LENGTH]}"
        now = time.monotonic()
        self._internal_errors = {
            each: at for each, at in self._internal_errors.items() if now - at < REPUBLISH_INTERVAL_S
        }
        if words not in self._internal_errors:
            self._internal_errors[words] = now
            self._log(Level.ERROR, INTERNAL_ERROR, words)
            with contextlib.suppress(Exception):  # the error may come from `on_failure` itself
                self.on_failure(words)
        return words

    def _log(self, level: Level, code: str, words: str) -> None:
        """Publish an event as foxglove.Log."""
        now_ns = time.time_ns()
        name = f"{keys.COORDINATOR} {code}"
        self._publisher("log").put(messages.log_message(now_ns, level, name, words), now_ns)

    # ------------------------------------------------------------------ other coordinators, the hub, publishers

    def _others(self) -> list[str]:
        operators = self.client.bus.tokens(f"{self.client.name}/{keys.OPERATOR}/*")
        names = [token.rpartition("/")[2] for token in operators]
        return sorted(name for name in names if name.startswith(SENDER) and name != self.client.sender)

    def _yield_to_another(self) -> None:
        """Raise AnotherCoordinator if one with a lower name started at the same moment."""
        others = [name for name in self._others() if name < self.client.sender]
        if others:
            raise AnotherCoordinator(self._describe(others))

    def _describe(self, others: list[str]) -> str:
        who = ", ".join(others) or "without a name"
        fleet = keys.describe_fleet(self.client.name).capitalize()
        return f"{fleet} has a coordinator already ({who}). Stop that one first."

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


def _rejected(refused: RequestRefused) -> pb.Result:
    return pb.Result(status=Phase.REJECTED, reason=refused.reason, words=str(refused))


def _payload(query: zenoh.Query) -> tuple[bytes, str]:
    """Return the payload of a query and its encoding, both empty if there is none."""
    payload = query.payload.to_bytes() if query.payload is not None else b""
    return payload, str(query.encoding) if query.encoding is not None else ""


def _plan_command(query: zenoh.Query) -> tuple[str, str]:
    """Return the text of the plan in a query (protobuf, JSON or plain text) and its sender. Raises BadPayload."""
    payload, encoding = _payload(query)
    if not encoding.startswith((topics.PROTOBUF, messages.JSON)):
        return payload.decode(), _ANONYMOUS
    message: Any = messages.parse(topics.TOPICS[f"{keys.COORDINATOR}/plan"].message, payload, encoding)
    return str(message.text), str(message.set_by) or _ANONYMOUS


def _sender(query: zenoh.Query, message_type: str) -> str:
    """Return the sender of a command with or without a payload. Raises BadPayload."""
    payload, encoding = _payload(query)
    command: Any = messages.parse(message_type, payload, encoding) if payload else None
    return str(command.sender if command is not None else "") or _ANONYMOUS


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


def _in_force(memory: PolicyState) -> tuple[str, list[int]]:
    """Return the phase and the rules in force."""
    return memory.phase.name, sorted(index for index, state in memory.rules.items() if state.on)


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
        rules=[plan.rules[index].name for index in _in_force(result.memory)[1]],
        stopped_by=result.memory.stopped_by,
    )
