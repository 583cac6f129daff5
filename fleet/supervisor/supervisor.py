"""The supervisor of `fleet up`: hub, simulator, recorder, gateways and coordinator, kept running until told to end.

When a process is started again is supervise/restart.py's part (pure), what it is told supervise/wanted.py's, what is
heard and asked over the bus supervise/desk.py's. Here is the loop that joins them, and the order of the end.
"""

import asyncio
import json
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Any, Final

from fleet.supervisor import spec
from fleet.supervisor.car_status import CarStatus, left_from_before
from fleet.supervisor.child import copied, new_run, remove_links
from fleet.supervisor.processes import TURN_S, ManagedProcess, ProcessSet
from fleet.supervisor.reload import change
from fleet.supervisor.restart_policy import GATEWAY_GRACE_S, RunState
from fleet.supervisor.service import ReloadRefused, SupervisorService
from fleet.supervisor.shutdown import GatewayShutdown
from fleet.supervisor.spec import COORDINATOR, HUB, RECORDER, SELF, SIMULATOR, CarProcessSpec, FleetSpec, ProcessKind
from schemas.bus import Bus, BusError, accepts, resolve_endpoint
from schemas.gen import fleet_v1_pb2 as pb
from schemas.keys import DEFAULT_FLEET

SECOND_S: Final = 1.0
HUB_UP_S: Final = 10.0
HUB_GONE_S: Final = 0.3
"""Sooner than gateways start one of their own (0.5 s)."""
RECORDER_FIRST_S: Final = 5.0
"""How long the cars wait for the recorder, so that it misses nothing."""
STOP_ASKED_S: Final = 0.5
END_S: Final = 5.0
TRIES_S: Final = 30.0
"""Time for which gateways that cannot stop their cars are replaced, if nobody is there to end it with Ctrl-C."""
RECORDER_END_S: Final = 30.0
"""It writes what it has."""


@dataclass(frozen=True, slots=True)
class SupervisorEvent:
    """Something that is worth a line. what: `process`, `car`, `hold`, `log`, `decision`, ..."""

    what: str
    name: str
    words: str


class Supervisor:
    """Keeps what is wanted running. `run` returns when all has ended: whether every car was stopped.

    `read` reads what is wanted anew, for a reload; it raises ValueError for what cannot be. `tell` hears what happens.
    """

    def __init__(
        self, wish: FleetSpec, source: str, read: Callable[[], FleetSpec], tell: Callable[[SupervisorEvent], None]
    ) -> None:
        self.endpoint = resolve_endpoint(wish.endpoint)
        self.rows: dict[str, CarStatus] = {}
        self.crew = ProcessSet(lambda name, words: self._say("process", name, words), self._said, self._ended)
        self._wish = wish
        self._source = source
        self._read = read
        self._tell = tell
        self._state = "starting"
        self._farewell = GatewayShutdown(
            self.crew, self.rows, lambda car, words: self._say("end", car, words), self._exists
        )
        self._desk: SupervisorService | None = None
        self._began = time.monotonic()
        self._began_wall_s = time.time()
        self._unlinked_since = self.crew.now
        self._linked_since: float | None = None
        self._gateways_from = 0.0
        self._end_asked = asyncio.Event()
        self._tries_until = inf
        self._reloading = asyncio.Lock()
        self._sim_asked: deque[bool] = deque()
        """Whose questions to the simulator wait for an answer: True for a user's."""
        self._sim_links: dict[str, str] = {}
        self._shown: object = None

    def end(self, why: str, tries_s: float = inf) -> None:
        """Begin to end; asked again, say what is waited for, and try no longer to stop cars that cannot be stopped.

        tries_s: for how long fresh gateways try that unless asked again.
        """
        if self._end_asked.is_set():
            waiting = ", ".join(process.name for process in self.crew if process.ward.alive)
            self._say("end", SELF, f"{why}: is ending already, waits for {waiting or 'nothing'}")
            self._farewell.hurry()
            return
        self._say("end", SELF, f"{why}: stopping every car, then closing the recording")
        self._tries_until = self.crew.now + tries_s
        self._end_asked.set()

    def tell_simulator(self, line: str) -> None:
        """Pass a line on to the simulator; its answer is a happening."""
        process = self.crew.get(SIMULATOR)
        if process is not None and process.child is not None and process.ward.alive:
            self._sim_asked.append(True)
            process.child.tell(line)
        else:
            self._say("simulator", SIMULATOR, json.dumps({"ok": False, "error": "no simulator is running"}))

    async def run(self) -> bool:
        """Supervise until `end`. Raises AnotherSupervisor, BusError, and OSError if there is no place for the logs."""
        self.crew.directory = await asyncio.to_thread(new_run, self._wish.fleet, self.endpoint, time.time())
        try:
            bus = await self._bus()
            if bus is None:
                self._say("end", SELF, "no car had been started")
                return True
            desk = self._desk = SupervisorService(bus, self._wish.fleet)
            await desk.open(self._heard, {"down": self._down, "reload": self._reload}, self.status)
            if not self._end_asked.is_set():
                self._populate()
            self._state = "running"
            each_second = asyncio.ensure_future(self._each_second(desk))
            try:
                while not self._end_asked.is_set():
                    await self._turn()
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._end_asked.wait(), TURN_S)
                await self._end_all(desk)
            finally:
                each_second.cancel()
                await asyncio.gather(each_second, return_exceptions=True)
            self._state = "ended"
            desk.publish(self.status())
            await asyncio.sleep(TURN_S)  # whoever waits for the end hears of it
        finally:
            await self._leave()
        return not self._farewell.not_stopped

    # ------------------------------------------------------------------ the bus

    async def _bus(self) -> Bus | None:
        """A session; the hub is started if there is none. None if it is to end before. Raises BusError."""
        self.crew.add(HUB, ProcessKind.HUB, spec.hub_command(self._wish, self.endpoint))
        deadline = self.crew.now + HUB_UP_S
        while not self._end_asked.is_set():
            await self._turn()
            if await asyncio.to_thread(accepts, self.endpoint):
                return await asyncio.to_thread(Bus.open, self.endpoint)
            hub = self.crew.get(HUB)
            if self.crew.now > deadline:
                words = hub.ward.words if hub is not None else ""
                raise BusError(f"no hub came up at {self.endpoint}: {words or 'it does not listen'}")
            await asyncio.sleep(TURN_S)
        return None

    async def _see_to_hub(self, now: float, *, linked: bool) -> None:
        """A hub that somebody else started serves as well as ours."""
        hub = self.crew.get(HUB)
        assert hub is not None
        if linked:
            self.crew.heard(HUB)
        gone = self._desk is not None and not linked and now - self._unlinked_since >= HUB_GONE_S
        due = hub.ward.state is RunState.WAITING and now >= hub.ward.due
        refused = hub.ward.state is RunState.REFUSED  # on a network that is not to be opened: the router there is back
        if (refused and linked) or (due and await asyncio.to_thread(accepts, self.endpoint)):
            hub.ward.elsewhere(now, f"somebody else's listens at {self.endpoint}")
        elif hub.ward.state is RunState.ELSEWHERE and gone and not await asyncio.to_thread(accepts, self.endpoint):
            hub.ward.wanted(now)

    async def _leave(self) -> None:
        """Off the bus, and the hub last; whatever still runs (something broke here) ends with it."""
        if self._desk is not None:
            await asyncio.to_thread(self._desk.bus.close)
            self._desk = None
        for process in self.crew:
            self.crew.end(process, GATEWAY_GRACE_S)
        await self.crew.gone(self.crew, GATEWAY_GRACE_S)

    # ------------------------------------------------------------------ what is to run

    def _populate(self) -> None:
        if self._wish.record:
            self.crew.add(RECORDER, ProcessKind.RECORDER, spec.recorder_command(self._wish, self.endpoint))
            self._gateways_from = self.crew.now + RECORDER_FIRST_S
        if self._wish.simulated:
            command = spec.simulator_command(self._wish, self.crew.directory, self.endpoint)
            self.crew.add(SIMULATOR, ProcessKind.SIMULATOR, command)
        for car in self._wish.cars.values():
            self._add_car(car)
        if command := self._coordinator(self._wish):
            self.crew.add(COORDINATOR, ProcessKind.COORDINATOR, command)

    def _add_car(self, car: CarProcessSpec) -> None:
        """Start its gateway, or do it anew with what is wanted now; a simulated car's as soon as its link is known."""
        self.rows.setdefault(car.name, CarStatus(car.name))
        link = self._sim_links.get(car.name) if car.link == spec.SIMULATED else car.link
        if link is not None:
            self._farewell.recall(car.name)
            self.crew.add(car.name, ProcessKind.GATEWAY, spec.gateway_command(self._wish, car, link, self.endpoint))

    def _coordinator(self, wish: FleetSpec) -> tuple[str, ...]:
        """Its command; empty without a plan. Raises OSError.

        It gets copies of plan and fleet file: what is changed there counts when it is reloaded and checked.
        """
        if wish.plan is None:
            return ()
        return self._coordinator_of(wish, wish.plan_text)

    def _coordinator_of(self, wish: FleetSpec, text: str) -> tuple[str, ...]:
        plan = copied(self.crew.directory, "plan", text)
        listed = copied(self.crew.directory, "fleet", spec.listing(wish))
        return spec.coordinator_command(wish, plan, listed, self.endpoint)

    def _in_force(self, plan: pb.Plan) -> None:
        """A plan that was given over the bus outlives the coordinator that took it, until a reload."""
        coordinator = self.crew.get(COORDINATOR)
        # The last words of one that is to begin anew say what was, and a reload sees to the command itself.
        if coordinator is None or coordinator.ward.state is not RunState.RUNNING or self._reloading.locked():
            return
        given = plan.text != self._wish.plan_text
        try:
            command = self._coordinator_of(self._wish, plan.text)
        except OSError as error:
            if given:
                words = f"was given over the bus, and cannot be kept for a coordinator after this one: {error.strerror}"
                self._say("process", COORDINATOR, f"plan {plan.version} {words}")
            return
        if command != coordinator.command:
            coordinator.command = command
            if given:
                words = f"plan {plan.version} was given over the bus: it is in force until a reload"
                self._say("process", COORDINATOR, words)

    async def _set_plan(self, desk: SupervisorService, old: FleetSpec, command: tuple[str, ...]) -> str:
        """See that the coordinator does what is wanted now; what is new about its plan."""
        coordinator = self.crew.get(COORDINATOR)
        if not command or coordinator is None:
            if command:
                self.crew.add(COORDINATOR, ProcessKind.COORDINATOR, command)
                return "there is a plan now"
            self.crew.remove(COORDINATOR, END_S)
            return "there is no plan any more: cars keep their modes" if coordinator is not None else ""
        text = self._wish.plan_text
        words = "" if text == old.plan_text else "the plan is changed"
        in_force = None
        if coordinator.ward.state is RunState.RUNNING:
            in_force = await asyncio.to_thread(desk.plan_in_force)
        if in_force is not None and in_force.text not in (text, old.plan_text):
            words = f"plan {in_force.version}, which was given over the bus, is replaced by {self._wish.plan}"
        has_it = in_force is not None and in_force.text == text
        if (
            in_force is not None
            and old.listed == self._wish.listed
            and (has_it or await asyncio.to_thread(desk.take_plan, text))
        ):
            coordinator.command = command
        else:
            # One that was given up has another chance.
            self.crew.add(COORDINATOR, ProcessKind.COORDINATOR, command, anew=not has_it and in_force is not None)
        return words

    # ------------------------------------------------------------------ one turn

    async def _turn(self) -> None:
        now = self.crew.now
        linked = self._desk is not None and self._desk.bus.connected
        if linked and self._linked_since is None:
            self._linked_since = now
        elif not linked and self._linked_since is not None:
            self._linked_since, self._unlinked_since = None, now
        await self._see_to_hub(now, linked=linked)
        self._farewell.turn(now)
        await self.crew.turn(self._listening_since, self._may_start, self._may_move)
        shown = [(process.name, process.ward.state, process.ward.restarts) for process in self.crew]
        if self._desk is not None and shown != self._shown:
            self._shown = shown
            self._desk.publish(self.status())

    def _listening_since(self, process: ManagedProcess) -> float | None:
        if process.kind is ProcessKind.HUB:
            return 0.0 if self._desk is not None else None
        return self._linked_since

    def _may_move(self, process: ManagedProcess) -> bool:
        """Return True if a gateway's car may move: only a gateway that was heard can say that it does not."""
        row = self.rows.get(process.name)
        return process.kind is ProcessKind.GATEWAY and (row is None or row.motors != "off")

    def _exists(self, car: str) -> bool:
        """Return True unless the car is simulated and its simulator has ended."""
        simulator = self.crew.get(SIMULATOR)
        wish = self._wish.cars.get(car)
        simulated = wish is not None and wish.link == spec.SIMULATED
        return not simulated or (simulator is not None and simulator.ward.alive)

    def _may_start(self, process: ManagedProcess) -> bool:
        if process.kind is ProcessKind.HUB or self._farewell.may_start(process.name):
            return True
        waits = process.kind is ProcessKind.GATEWAY and self.crew.now < self._gateways_from
        return not waits and not self._end_asked.is_set()

    # ------------------------------------------------------------------ what is heard

    @property
    def _options(self) -> str:
        """What a command for this fleet needs besides the car."""
        name = "" if self._wish.fleet == DEFAULT_FLEET else f" --fleet {self._wish.fleet}"
        return name if self.endpoint == resolve_endpoint() else f"{name} --connect {self.endpoint}"

    def _ended(self, process: ManagedProcess, told: bool) -> None:  # noqa: FBT001 - the crew calls it so
        if process.kind is ProcessKind.SIMULATOR:
            self._sim_asked.clear()
            remove_links(self.crew.directory)
        if process.kind is not ProcessKind.GATEWAY:
            return
        row = self.rows.get(process.name)
        if row is not None:
            row.gone()
        self._farewell.ended(process)
        if self._farewell.may_start(process.name):
            return
        if process.leaving:
            self.rows.pop(process.name, None)
        elif told and process.code != 0 and process.ward.state is RunState.WAITING:
            self._say("process", process.name, f"ended without stopping its car: {process.why or process.ward.words}")

    def _heard(self, car: str, topic: str, value: Any) -> None:
        row = self.rows.get(car)
        if car == RECORDER and self.crew.heard(RECORDER):
            self._gateways_from = self.crew.now
        elif car == COORDINATOR:
            self._in_force(value)
        elif row is not None and topic == "state/health":
            # The last words of a process that has ended are no sign of life of the next, nor what it shows.
            if self.crew.heard(car, value.pid):
                row.gone()
        elif row is not None:
            if topic == "state/safety" and not row.welcomed:
                row.welcomed = True
                if words := left_from_before(car, value, self._began_wall_s, self._options):
                    self._say("hold", car, words)
            if words := row.take(topic, value, time.monotonic()):
                self._say("car", car, words)
            if topic == "event/log":
                self._say("log", car, row.event)

    def _said(self, process: ManagedProcess, line: str) -> None:
        """A line of a process's stdout."""
        try:
            told = json.loads(line)
        except ValueError:
            return  # it is in the log
        if process.kind is ProcessKind.RECORDER:
            self._say("process", RECORDER, _recording(told))
        elif process.kind is ProcessKind.COORDINATOR:
            self._say("decision", told["subject"], f"{told['decided']}, because {told['why']}")
        if process.kind is not ProcessKind.SIMULATOR:
            return
        self.crew.heard(SIMULATOR)
        if "link" in told and told.get("car") in self._wish.cars:
            self._sim_links[told["car"]] = told["link"]
            if not self._end_asked.is_set():
                self._add_car(self._wish.cars[told["car"]])
        elif "ok" in told and self._sim_asked and self._sim_asked.popleft():
            self._say("simulator", SIMULATOR, line)

    async def _each_second(self, desk: SupervisorService) -> None:
        """Ask who says nothing by itself for a sign of life, and say how things are."""
        question = json.dumps({"car": next((car.name for car in self._wish.simulated), ""), "ask": "truth"})
        asking: asyncio.Future[bool] | None = None
        while True:
            simulator, coordinator = self.crew.get(SIMULATOR), self.crew.get(COORDINATOR)
            if simulator is not None and simulator.child is not None and simulator.ward.alive:
                self._sim_asked.append(False)
                simulator.child.tell(question)
            if asking is not None and asking.done():
                if asking.result():
                    self.crew.heard(COORDINATOR)
                asking = None
            if coordinator is not None and coordinator.ward.alive and asking is None:
                asking = asyncio.ensure_future(asyncio.to_thread(desk.coordinator_answers))
            desk.publish(self.status())
            await asyncio.sleep(SECOND_S)

    # ------------------------------------------------------------------ the end

    async def _end_all(self, desk: SupervisorService) -> None:
        """The coordinator first, so that it opens nothing again; every car; the recording; the simulated cars."""
        self._state = "ending"
        desk.publish(self.status())
        gateways = self.crew.of(ProcessKind.GATEWAY)
        for process in self.crew.of(ProcessKind.COORDINATOR):
            self.crew.end(process, END_S)
        asked = asyncio.ensure_future(asyncio.to_thread(desk.stop_all))
        await asyncio.wait([asked], timeout=STOP_ASKED_S)
        for process in gateways:
            self._farewell.begin(process)
        await self._until_ended([*gateways, *self.crew.of(ProcessKind.COORDINATOR)])
        for kind, grace in ((ProcessKind.RECORDER, RECORDER_END_S), (ProcessKind.SIMULATOR, END_S)):
            for process in self.crew.of(kind):
                self.crew.end(process, grace)
                await self._until_ended([process])
        await asyncio.wait([asked], timeout=END_S)
        left = ", ".join(self._farewell.not_stopped)
        words = "every car that was started is stopped" if self._farewell.became else "no car had been started"
        self._say("end", SELF, f"not stopped: {left}: look whether they drive" if left else words)

    async def _until_ended(self, processes: list[ManagedProcess]) -> None:
        while self._farewell.going or any(process.ward.alive for process in processes):
            if self.crew.now > self._tries_until:
                self._tries_until = inf
                self._farewell.hurry()
            await self._turn()
            await asyncio.sleep(TURN_S / 2)

    # ------------------------------------------------------------------ what is asked

    def status(self) -> pb.Supervision:
        """How things are."""
        now = self.crew.now
        message = pb.Supervision(
            state=self._state,
            host=socket.gethostname(),
            pid=os.getpid(),
            uptime_s=time.monotonic() - self._began,
            fleet_file=self._source,
            directory=str(self.crew.directory),
            became=self._farewell.became,
        )
        for process in self.crew:
            ward = process.ward
            shown = message.processes.add(name=process.name, kind=process.kind, state=ward.state, words=ward.words)
            shown.restarts, shown.since_s = ward.restarts, now - ward.since if ward.since else 0.0
            if process.child is not None and ward.alive:
                shown.pid = process.child.pid
        return message

    async def _down(self, sender: str) -> str:
        self.end(f"fleet down by {sender}", TRIES_S)
        return "stopping every car, then closing the recording"

    async def _reload(self, sender: str) -> str:
        """Read what is wanted anew and do what can be done; what was done, and what cannot. Raises Refused."""
        async with self._reloading:
            return await self._reload_alone(sender)

    async def _reload_alone(self, sender: str) -> str:
        try:
            new = await asyncio.to_thread(self._read)
        except ValueError as error:
            raise ReloadRefused(f"nothing was changed: {error}") from None
        if self._end_asked.is_set():
            raise ReloadRefused("nothing was changed: the fleet is ending")
        old, found = self._wish, change(self._wish, new)
        try:
            command = self._coordinator(found.wish)  # what may fail comes first
        except OSError as error:
            why = f"the coordinator's copies cannot be written in {self.crew.directory}: {error.strerror}"
            raise ReloadRefused(f"nothing was changed: {why}") from None
        words = list(found.words)
        self._wish = found.wish
        for name in found.gone:
            process = self.crew.get(name)
            if process is not None:
                process.leaving = True
                self._farewell.begin(process)
                self.crew.forget(process)
            if self.crew.get(name) is None:
                self.rows.pop(name, None)
        for name in found.begun:
            self._add_car(self._wish.cars[name])
        assert self._desk is not None  # it was asked there
        if planned := await self._set_plan(self._desk, old, command):
            words.append(planned)
        for line in words:
            self._say("process", SELF, f"reload by {sender}: {line}")
        return "\n".join([*(words or ["nothing has changed"]), *found.wish.doubts])

    def _say(self, what: str, name: str, words: str) -> None:
        self._tell(SupervisorEvent(what, name, words))


def _recording(told: Mapping[str, Any]) -> str:
    if told["state"] != "closed":
        return f"recording to {told['session']}"
    lost = sum(told["drops"].values()) + sum(told["missed"].values())
    return f"recording closed: {told['session']}, {told['messages']} messages, {lost} lost"
