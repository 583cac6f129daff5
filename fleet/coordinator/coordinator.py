"""The coordinator: a client of the bus with a policy. Samples come in, commands and publications go out.

policy/ makes all decisions. One of them is to send nothing to a car on hold. The gateway enforces the hold, too.
"""

import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from typing import Final, TypeVar

import zenoh
from msgspec.structs import replace

from fleet.client.client import Fleet
from fleet.coordinator.inbox import Inbox, Item, QueriedSample
from fleet.coordinator.observer import FleetObserver
from fleet.coordinator.open_commands import OpenCommands
from fleet.coordinator.other_coordinators import SENDER, AnotherCoordinator, declare_alone, yield_to_another
from fleet.coordinator.plan_query_parser import PLAN_VERB, bad_value, plan_command, rejected, reply_result, sender_of
from fleet.coordinator.plan_state_file import CoordinatorStateFile
from fleet.coordinator.publications import Publications, assignment_message, decision_message, in_force
from fleet.policy.decide import step
from fleet.policy.decision import Decision, DecisionKind
from fleet.policy.lint.lint import find_faults
from fleet.policy.plan.plan import Plan
from fleet.policy.plan.plan_parser import parse
from fleet.policy.plan_requests import EVENTS, PlanRequest, RequestRefused, check_sender, on_request
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, Refusal, may_move_by_plan, topic_of
from fleet.policy.state import PolicyState, carry_over, on_hub_back, restore, to_persisted
from schemas import keys, messages
from schemas.bus import HubKeeper
from schemas.gen import fleet_v1_pb2 as pb
from schemas.limits import SHUTDOWN_S
from schemas.process.computer_sleep import MONOTONIC_COUNTS_SLEEP, SleepWatch, clock_pair
from schemas.rights import People
from schemas.words import Level, Mode, Phase

STEP_INTERVAL_S: Final = 0.1
MIN_REST_S: Final = 1.0
"""Minimum time at the end for the commands that bring cars to rest, also after a second Ctrl-C."""
SINGLETON_RECHECK_S: Final = 1.0
"""Delay of the second search for other coordinators. Two that start at the same moment do not find each other at first.
"""
_MAX_STATE_QUERIES: Final = 3
"""Maximum number of queries for the cars' states at the start. A stalled gateway may miss the first one."""
T = TypeVar("T")
_PLAN_SET: Final = "plan_set"
_UNSAVED: Final = "It cannot be saved: a restarted coordinator will not know it."


@dataclass(slots=True)
class Coordinator:
    """Commands cars by a plan. `client` has the kind coordinator, and a sender that begins with SENDER.

    The coordinator calls `on_decision` for each changed decision, and `on_failure` for each new failure (of a command,
    of the hub, or inside the coordinator) and each warning about a plan from the bus. `listed` has the cars in the
    fleet file, and is empty without a file. The caller must have checked `plan` with lint.find_faults().
    """

    client: Fleet
    plan: Plan
    on_decision: Callable[[Decision], None]
    on_failure: Callable[[str], None]
    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    people: People | None = None
    """The people in the fleet file, who may change the plan. If None, the people whom the gateways know may."""
    run_name: str = ""
    """Name of its `fleet up` run. In a new run, the plan starts from the beginning."""
    sleep: SleepWatch = field(default_factory=lambda: SleepWatch(clock_pair()))
    _memory: PolicyState = field(default_factory=PolicyState)
    _state_file: CoordinatorStateFile | None = None
    _restored: bool = False
    """True once the persisted state is restored."""
    _sent_off: set[str] = field(default_factory=set)
    """The cars whose last mode by the plan lets them move by themselves, also those that cannot be reached now."""
    _persisted: PolicyState | None = None
    """The state to persist from now on, because the coordinator is ending. None before that."""
    _early: list[zenoh.Query] = field(default_factory=list)
    """Commands that came before the persisted state was restored."""
    _inbox: Inbox = field(init=False)
    _publications: Publications = field(init=False)
    _commands: OpenCommands = field(init=False)

    def __post_init__(self) -> None:
        self._inbox = Inbox(self.client, lambda: {"state/*", *(topic_of(name) for name in self.plan.read_names)})
        self._publications = Publications(self.client, self.on_failure)
        self._commands = OpenCommands(self.client, self.on_failure)

    def run(self, has_ended: Callable[[], bool], gives_up: Callable[[], bool] = lambda: False) -> list[str]:
        """Coordinate until `has_ended()`. Then bring the cars of the plan to rest, until `gives_up()`.

        Return the cars that may still be moving. In a run of `fleet up`, the cars keep their modes, and none is
        returned: the supervisor stops them, or starts the coordinator again. Raises AnotherCoordinator, and then leaves
        the cars to the other one.
        """
        bus, fleet = self.client.bus, self.client.name
        declare_alone(self.client)
        observer = FleetObserver(self.listed)
        state_file = self._state_file = CoordinatorStateFile(fleet, bus.endpoint, self.run_name)
        self._inbox.subscribe(f"{fleet}/*/state/*")
        self._inbox.watch_gateways()
        self._put_in_force(self.plan)
        bus.queryable(f"{fleet}/{keys.COORDINATOR}/*", self._inbox.on_query)
        for verb in (PLAN_VERB, *PlanRequest):
            for expression in keys.command_keys(fleet, keys.COORDINATOR, verb):
                bus.queryable(expression, self._inbox.on_query)
        recheck_at = time.monotonic() + SINGLETON_RECHECK_S
        with ThreadPoolExecutor(max_workers=32) as pool:
            try:
                self._drain_inbox(observer, pool, wait_s=0.0)
                for _ in range(_MAX_STATE_QUERIES):
                    self._inbox.query_states()
                    self._drain_inbox(observer, pool, wait_s=0.0)
                    if not observer.unconfirmed:
                        break
                now = time.monotonic()
                self._memory = restore(self.plan, observer.snapshot(()), state_file.load(), now, time.time())
                self._restored = True
                for query in self._early:
                    self._answer(query, observer)
                moving: list[str] = []
                try:
                    self._coordinate(observer, pool, recheck_at, has_ended)
                finally:
                    if not self.run_name and not isinstance(sys.exception(), AnotherCoordinator):
                        moving = self._bring_to_rest(observer, pool, gives_up)
            finally:
                self.client.close()  # ends pending commands
        return moving

    def _coordinate(
        self, observer: FleetObserver, pool: ThreadPoolExecutor, recheck_at: float, has_ended: Callable[[], bool]
    ) -> None:
        """Coordinate until `has_ended()`. At `recheck_at`, search once more for other coordinators."""
        bus = self.client.bus
        link, hub_keeper = bus.link, HubKeeper(bus.endpoint, self.on_failure)
        while not has_ended():
            # Read the link before the inbox. If it is gone at that moment, the inbox says afterwards which gateways
            # were lost with it.
            current_link = bus.link
            self._drain_inbox(observer, pool)
            now = time.monotonic()
            self._check_sleep(observer, now)
            hub_keeper.check(connected=bool(current_link))
            if not current_link:
                continue
            if current_link != link:
                link, self._memory = current_link, on_hub_back(self._memory, now)
            self._try_step(observer, pool, now)
            if now >= recheck_at:
                recheck_at = inf
                yield_to_another(self.client)
            self._publications.republish(now)

    def _bring_to_rest(
        self, observer: FleetObserver, pool: ThreadPoolExecutor, gives_up: Callable[[], bool]
    ) -> list[str]:
        """Bring the cars of the plan to rest, as `fleet plan stop` does. Return those that may still be moving.

        Wait for at most SHUTDOWN_S, also for a hub, a gateway or a link that is gone. A person who ends a coordinator
        by hand and starts another one wants the plan to go on. So the persisted state stays that from before.
        """
        self._persisted = replace(self._memory, stopped_by="", to_rest=frozenset())
        bus, shown, began = self.client.bus, self.on_decision, time.monotonic()
        self.on_decision = lambda decision: _if_possible(shown, decision)
        hub_keeper = HubKeeper(bus.endpoint, lambda words: _if_possible(self.on_failure, words))
        by = self.client.sender.removeprefix(SENDER)
        self._memory, _ = on_request(PlanRequest.STOP, self.plan, self._memory, by, began)
        self._memory = replace(self._memory, to_rest=self._memory.to_rest | self._sent_off)
        self._save(self._memory)  # also if no step follows, because the hub is gone
        cars = sorted(self._memory.to_rest)
        while True:
            now, link = time.monotonic(), bus.link
            hub_keeper.check(connected=bool(link))
            if link:
                self._try_step(observer, pool, now)
            self._drain_inbox(observer, pool)
            asked = {each.car for each in self._memory.decisions.values() if each.kind is DecisionKind.IDLE}
            moving = [
                car
                for car in cars
                if car in asked or may_move_by_plan(observer.cars.get(car, UNKNOWN_CAR), sent_off=car in self._sent_off)
            ]
            waited_s = time.monotonic() - began
            if not moving or waited_s >= SHUTDOWN_S or (gives_up() and waited_s >= MIN_REST_S):
                break
        if moving:
            names = ", ".join(moving)
            _if_possible(self.on_failure, f"NOT CONFIRMED: {names} may still be moving. Type `fleet stop`.")
        return moving

    def _check_sleep(self, observer: FleetObserver, now: float) -> None:
        """After a sleep of the computer, decide only by new readings. No car loses its role because of the sleep."""
        if (slept_s := self.sleep.take()) > 0:
            observer.on_sleep(0.0 if MONOTONIC_COUNTS_SLEEP else slept_s)
            self._memory = on_hub_back(self._memory, now)

    # ------------------------------------------------------------------ one step

    def _try_step(self, observer: FleetObserver, pool: ThreadPoolExecutor, now: float) -> None:
        try:
            self._step(observer, pool, now)
        except OSError:  # our own output is closed, because the parent process has ended
            raise
        except Exception as error:  # noqa: BLE001 - the input came over the bus
            self._publications.log_internal_error("deciding", error)

    def _step(self, observer: FleetObserver, pool: ThreadPoolExecutor, now: float) -> None:
        for command, outcome in self._commands.outcomes():
            assert command.mode is not None
            refusal = None if outcome.ok else Refusal(command.mode, outcome.reason, outcome.words, now)
            observer.on_outcome(command.car, command.mode, refusal)
        observer.forget(now, {*self.plan.named_cars, *self._memory.held_roles, *self._commands.busy})
        result = step(self.plan, observer.snapshot(self._commands.busy), self._memory, now)
        before, self._memory = self._memory, result.memory
        # Persist before anything is published or commanded. If this coordinator is killed now, the next one knows the
        # state.
        self._save(self._memory)
        gone = before.decisions.keys() - result.memory.decisions.keys()
        self._publications.forget(gone)
        self._commands.forget(gone)
        for decision in result.decisions:
            if decision.car is None or decision.mode is None or self._persisted is not None:
                continue
            if decision.mode is Mode.MANUAL:
                self._sent_off.discard(decision.car)
            else:
                self._sent_off.add(decision.car)
        since_s = time.time() - now
        for decision in (*result.changed, *result.reworded):
            self._publications.publish("decision", decision_message(decision, since_s + decision.since))
        for decision in result.changed:
            self.on_decision(decision)
        if result.changed or in_force(before) != in_force(result.memory):
            self._publications.publish("assignment", assignment_message(self.plan, result))
        self._commands.send(result.commands, pool)

    # ------------------------------------------------------------------ the plan

    def _save(self, memory: PolicyState) -> bool:
        """Persist the state. Return False if it cannot be written."""
        assert self._state_file is not None
        kept = memory if self._persisted is None else self._persisted
        return self._state_file.save(to_persisted(self.plan, kept, time.monotonic(), time.time()))

    def _check_request(self, observer: FleetObserver, by: str) -> None:
        """Raise RequestRefused if the sender may not change the plan, or if this coordinator is ending."""
        check_sender(observer.people if self.people is None else self.people, by)
        if self._persisted is not None:
            raise RequestRefused("This coordinator is ending. `fleet plan run` starts another one.")

    def _on_request(self, query: zenoh.Query, request: PlanRequest, observer: FleetObserver) -> None:
        """Carry out a request for the plan in force. Persist the state and publish an event before the reply."""
        try:
            by = sender_of(query, "fleet.v1.PlanCommand")
            self._check_request(observer, by)
            memory, words = on_request(request, self.plan, self._memory, by, time.monotonic())
        except RequestRefused as refused:
            reply_result(query, rejected(refused))
            return
        except messages.BadPayload as error:
            reply_result(query, bad_value(f"{error} [bad_value]"))
            return
        if request is not PlanRequest.NEXT and memory is not self._memory:
            self._publications.forget()
        self._memory = memory
        saved = self._save(memory)
        code, did = EVENTS[request]
        self._publications.log(Level.INFO, code, f"{keys.name_of(by)} {did} ({words})")
        reply_result(query, pb.Result(status=Phase.SENT, words=words if saved else f"{words}. {_UNSAVED}"))

    def _put_in_force(self, plan: Plan, set_by: str = "") -> None:
        """Put a plan in force: subscribe to the readings that it uses, and publish it."""
        self.plan = plan
        for topic in sorted({topic_of(name) for name in plan.read_names}):
            if not topic.startswith("state/"):
                self._inbox.subscribe(f"{self.client.name}/*/{topic}")
        self._publications.publish("plan", pb.Plan(text=plan.text, version=plan.version, set_by=set_by))

    def _on_plan(self, query: zenoh.Query, observer: FleetObserver) -> None:
        """Put the plan of a query in force, or refuse it with all its faults."""
        result = pb.Result(status=Phase.SENT)
        try:
            text, by = plan_command(query)
            self._check_request(observer, by)
            plan = parse(text)
        except RequestRefused as refused:
            result = rejected(refused)
        except (ValueError, messages.BadPayload) as error:  # BadPlan and UnicodeDecodeError are ValueErrors
            result = bad_value(str(error))
        else:
            plan_faults = find_faults(plan, self.listed or None, observer.present)
            if plan_faults.errors:
                result = bad_value(plan_faults.refusal())
            else:
                warnings = [f"warning: {each}" for each in plan_faults.warnings]
                result.words = "\n".join((f"plan {plan.version} is in force", *warnings))
                self._take_over(plan, by)
                for each in plan_faults.warnings:
                    self.on_failure(f"the new plan: {each}")
        reply_result(query, result)

    def _take_over(self, plan: Plan, by: str) -> None:
        self._memory = carry_over(self._memory, self.plan, plan)
        self._publications.forget()
        self._put_in_force(plan, by)
        self._save(self._memory)
        self._publications.log(Level.INFO, _PLAN_SET, f"{keys.name_of(by)} put plan {plan.version} in force")
        self._inbox.query_states()

    # ------------------------------------------------------------------ samples and queries

    def _drain_inbox(self, observer: FleetObserver, pool: ThreadPoolExecutor, wait_s: float = STEP_INTERVAL_S) -> None:
        """Handle all items in the inbox. Wait at most `wait_s` for the first."""
        for item in self._inbox.items(wait_s):
            # Handle tokens first: a gateway declares its token before it publishes states.
            self._handle_gateways(observer, pool)
            try:
                self._handle(item, observer)
            except OSError:  # our own output is closed, because the parent process has ended
                raise
            except Exception as error:  # noqa: BLE001 - no input from the bus may end a coordinator
                self._publications.log_internal_error("handling what came over the bus", error)
        self._handle_gateways(observer, pool)

    def _handle(self, item: Item, observer: FleetObserver) -> None:
        now = time.monotonic()
        if isinstance(item, zenoh.Query):
            if not self._restored and "/@cmd/" in str(item.key_expr):
                self._early.append(item)
            else:
                self._answer(item, observer)
        elif isinstance(item, QueriedSample):
            observer.on_sample(item.sample, now, time.time())
        else:
            observer.on_sample(item, now, None)

    def _handle_gateways(self, observer: FleetObserver, pool: ThreadPoolExecutor) -> None:
        """Note arrived and lost gateways, and query the states of those that arrived."""
        now, changes = time.monotonic(), self._inbox.gateways()
        for car, alive in changes.items():
            observer.on_token(car, now, alive=alive)
        self._inbox.query_arrived(changes, pool, began=self._memory.started_at is not None)

    def _answer(self, query: zenoh.Query, observer: FleetObserver) -> None:
        with query:
            try:
                self._reply(query, observer)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001 - each query gets a reply, and the coordinator keeps running
                words = self._publications.log_internal_error(f"answering {query.key_expr}", error)
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
        self._publications.reply(query)


def _if_possible(report: Callable[[T], None], what: T) -> None:
    """Report something, unless our own output is closed. The cars come to rest all the same."""
    with suppress(OSError):
        report(what)
