"""The supervisor of `fleet up`: keeps hub, simulator, recorder, gateways and coordinator running until the shutdown.

It contains the loop that joins the other modules of this package, and the order of the shutdown.
"""

import asyncio
import json
import os
import shlex
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, Final

from msgspec import Struct

from fleet.client.hints import complete_hints, fleet_options
from fleet.client.services import why_unrecorded
from fleet.fleetfile.fleet_file import people_table
from fleet.policy.denial_words import fleet_refusal
from fleet.supervisor import spec
from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.log_files import Log, new_run, remove_links, write_copy
from fleet.supervisor.process_state import GATEWAY_GRACE_S
from fleet.supervisor.processes import SUPERVISOR_POLL_INTERVAL_S, ManagedProcess, ProcessSet
from fleet.supervisor.reload import compare
from fleet.supervisor.shutdown import NOT_TRIED, GatewayShutdown, describe_end
from fleet.supervisor.spec import (
    CONSOLE,
    COORDINATOR,
    HUB,
    RECORDER,
    SELF,
    SIMULATOR_PROCESS,
    CarProcessSpec,
    FleetSpec,
)
from fleet.supervisor.start_report import StartProgress, describe_old_stops, describe_start
from fleet.supervisor.supervisor_service import CommandRefused, RestartNeeded, SupervisorService
from schemas.bus import Bus, BusError, accepts, resolve_endpoint
from schemas.gen import fleet_v1_pb2 as pb
from schemas.identity import Service, service
from schemas.keys import name_of
from schemas.words import LinkState, Motors, ProcessKind, RecorderState, RunState
from schemas.yaml_document.document import BadFile

STATUS_INTERVAL_S: Final = 1.0
HUB_START_TIMEOUT_S: Final = 10.0
SUPERVISOR_HUB_RESTART_DELAY_S: Final = 0.3
"""Time without a link after which the supervisor starts a hub in place of another program's. Other programs would start
one after 0.5 s."""
RECORDER_START_TIMEOUT_S: Final = 5.0
"""Timeout for the recorder's first heartbeat. Gateways and the coordinator start only after this heartbeat or timeout,
so that the recorder misses nothing."""
SILENT_PROCESS_S: Final = 3.0
"""Silence after which a process is named as not ready. It has then missed at least two heartbeats, and may hang."""
RECORDER_LOST_S: Final = 2.0
"""Time without a status of a recorder after which the fleet counts as not recorded. A recorder sends one each
second."""
STOP_QUERY_TIMEOUT_S: Final = 0.5
SERVICE_EXIT_TIMEOUT_S: Final = 5.0
CAR_STOP_RETRY_S: Final = 30.0
"""Timeout for retries to stop a car, if nobody is there to cancel them with Ctrl-C."""
RECORDER_EXIT_TIMEOUT_S: Final = 30.0
"""Timeout for the recorder's exit, because it must still write its buffers."""


READY: Final = "ready"
"""The event that ends a start: all cars and services are ready."""
MISSING: Final = "missing"
"""The event that ends a start with missing cars or services."""
_LOGGED_ELSEWHERE: Final = ("log", "decision", "simulator")
"""Events that are in the logs of other processes."""


class SupervisorEvent(Struct, frozen=True):
    """An event that is reported in a line. what: `process`, `car`, `hold`, `log`, `decision`, READY, MISSING, ..."""

    what: str
    name: str
    words: str


class Supervisor:
    """Keeps the processes of a fleet running.

    `run` returns True if no car may be moving, and the recording, if there is one, was in order at the end. `read`
    reads the spec again for a reload, and raises ValueError if it is invalid. `on_event` gets each event.
    """

    def __init__(
        self,
        fleet_spec: FleetSpec,
        source: str,
        read: Callable[[], FleetSpec],
        on_event: Callable[[SupervisorEvent], None],
    ) -> None:
        self.endpoint = resolve_endpoint(fleet_spec.endpoint)
        self.rows: dict[str, CarStatus] = {}
        self.processes = ProcessSet(lambda name, words: self._say("process", name, words), self._on_line, self._on_exit)
        self._spec = fleet_spec
        self._source = source
        self._read = read
        self._on_event = on_event
        self._state = RunState.STARTING
        self._shutdown = GatewayShutdown(
            self.processes, self.rows, lambda car, words: self._say("end", car, words), self._exists
        )
        self._service: SupervisorService | None = None
        self._began = time.monotonic()
        self._began_wall_s = time.time()
        self._unlinked_since = self.processes.now
        self._linked_since: float | None = None
        self._recorded_from = 0.0
        self._shutdown_requested = asyncio.Event()
        self._tries_until = inf
        self._reloading = asyncio.Lock()
        self._sim_asked: deque[bool] = deque()
        """Pending queries to the simulator, in order. True for a user's query."""
        self._sim_links: dict[str, str] = {}
        self._shown: object = None
        self._session = ""
        self._recorder_heard_at = inf
        """The time of the last status from any recorder of this fleet."""
        self._unrecorded = ""
        """Why nothing is recorded now, although it should be."""
        self._drops: dict[str, int] = {}
        """How many messages the recorder has dropped in each session."""
        self._console = ""
        """Address of the web page."""
        self.starting = True
        self._progress = StartProgress()
        self._log: Log | None = None

    def end(self, why: str, tries_s: float = inf) -> None:
        """Start the shutdown. At the second call, list the pending processes and stop retrying.

        tries_s: timeout for retries to stop a car.
        """
        if self._shutdown_requested.is_set():
            waiting = ", ".join(process.name for process in self.processes if process.status.alive)
            self._say("end", SELF, f"{why}: the fleet is ending already, and waits for {waiting or 'nothing'}")
            self._shutdown.hurry()
            return
        self._say("end", SELF, f"{why}: stopping every car, then closing the recording")
        self._tries_until = self.processes.now + tries_s
        self._shutdown_requested.set()

    def tell_simulator(self, line: str) -> None:
        """Send a line to the simulator. Its answer becomes an event."""
        process = self.processes.get(SIMULATOR_PROCESS)
        if process is not None and process.child is not None and process.status.alive:
            self._sim_asked.append(True)
            process.child.write_line(line)
        else:
            self._say("simulator", SIMULATOR_PROCESS, json.dumps({"ok": False, "error": "no simulator is running"}))

    async def run(self) -> bool:
        """Supervise until `end`. Raises AnotherSupervisor, BusError, and OSError if the logs cannot be written."""
        self.processes.directory = await asyncio.to_thread(new_run, self._spec.fleet, self.endpoint, time.time())
        self._log = Log(self.log_path)
        try:
            bus = await self._bus()
            if bus is None:
                self._say("end", SELF, "no car had been started")
                return True
            service = self._service = SupervisorService(bus, self._spec.fleet)
            handlers = {"down": self._down, "reload": self._reload}
            await service.open(self._on_message, handlers, self.status, self._refusal)
            if not self._shutdown_requested.is_set():
                self._populate()
            self._state = RunState.RUNNING
            heartbeats = asyncio.ensure_future(self._heartbeats(service))
            try:
                while not self._shutdown_requested.is_set():
                    await self._turn()
                    self._follow_start(self.processes.now)
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._shutdown_requested.wait(), SUPERVISOR_POLL_INTERVAL_S)
                await self._end_all(service)
            finally:
                heartbeats.cancel()
                await asyncio.gather(heartbeats, return_exceptions=True)
            self._state = RunState.ENDED
            service.publish(self.status())
            await asyncio.sleep(SUPERVISOR_POLL_INTERVAL_S)  # `fleet down` waits for this status
        finally:
            await self._leave()
            self._log.close()
        return not (self._shutdown.not_stopped or self._lost)

    @property
    def log_path(self) -> Path:
        """The file of the supervisor's own log."""
        return self.processes.directory / f"{SELF}.log"

    def missing(self) -> dict[str, str]:
        """Return the cars and services that are not ready, each with the reason."""
        result, now = {}, time.monotonic()
        for name in self._spec.cars:
            process, row = self.processes.get(name), self.rows.get(name)
            if process is None or row is None:
                result[name] = "its simulator is starting"
            elif process.status.state is not RunState.RUNNING:
                result[name] = process.status.words or "its gateway is starting"
            elif why := row.state.why_missing(now):
                result[name] = why
        for process in self.processes:
            if process.kind is not ProcessKind.GATEWAY and (why := self._why_not_up(process)):
                result[process.name] = why
        if self._unrecorded:
            result.setdefault(RECORDER, self._unrecorded)
        return result

    def _why_not_up(self, process: ManagedProcess) -> str:
        """Return why a service does not work now. Empty if it does."""
        if process.status.state not in (RunState.RUNNING, RunState.ELSEWHERE):
            return process.status.words or str(process.status.state)
        silent_s = process.status.silent_s(self.processes.now, self._listening_since(process))
        is_silent = process.status.state is RunState.RUNNING and silent_s > SILENT_PROCESS_S
        return f"it has not answered for {silent_s:.0f} s" if is_silent else ""

    def _follow_start(self, now: float) -> None:
        """Report the end of the start once: all cars and services are ready, or none has become ready for a while."""
        if not self.starting:
            return
        missing = self.missing()
        links = [row.state.link if (row := self.rows.get(name)) else None for name in missing]
        unreachable = all(link and link.state == LinkState.LOST and link.reason != NOT_TRIED for link in links)
        if not self._progress.has_ended(len(missing), now, unreachable=unreachable):
            return
        words = describe_start(list(self._spec.cars), missing, self._session, self._console)
        self._say(MISSING if missing else READY, SELF, words)
        self.starting = False

    # ------------------------------------------------------------------ the bus

    async def _bus(self) -> Bus | None:
        """Open a session, and start the hub if there is none. Return None if the shutdown comes first.

        Raises BusError.
        """
        self.processes.add(HUB, ProcessKind.HUB, spec.hub_command(self._spec, self.endpoint))
        deadline = self.processes.now + HUB_START_TIMEOUT_S
        while not self._shutdown_requested.is_set():
            await self._turn()
            if await asyncio.to_thread(accepts, self.endpoint):
                return await asyncio.to_thread(partial(Bus.open, self.endpoint, identity=service(Service.SUPERVISOR)))
            hub = self.processes.get(HUB)
            if self.processes.now > deadline:
                words = hub.status.words if hub is not None else ""
                raise BusError(f"no hub came up at {self.endpoint}: {words or 'it does not listen'}")
            await asyncio.sleep(SUPERVISOR_POLL_INTERVAL_S)
        return None

    async def _check_hub(self, now: float, *, linked: bool) -> None:
        """Restart the hub if it is missing. A hub that another program started serves as well."""
        hub = self.processes.get(HUB)
        assert hub is not None
        if linked:
            self.processes.on_heartbeat(HUB)
        is_lost = (
            self._service is not None and not linked and now - self._unlinked_since >= SUPERVISOR_HUB_RESTART_DELAY_S
        )
        due = hub.status.state is RunState.WAITING and now >= hub.status.due
        refused = hub.status.state is RunState.REFUSED  # our hub may not listen at this endpoint
        if (refused and linked) or (due and await asyncio.to_thread(accepts, self.endpoint)):
            hub.status.served_elsewhere(now, f"another program's hub listens at {self.endpoint}")
        elif hub.status.state is RunState.ELSEWHERE and is_lost and not await asyncio.to_thread(accepts, self.endpoint):
            hub.status.schedule(now)

    def _check_recorder(self, now: float) -> None:
        """Report that nothing is recorded, if our recorder does not run and no other recorder is heard."""
        recorder = self.processes.get(RECORDER)
        if recorder is None or self._shutdown_requested.is_set() or now < self._recorder_heard_at + RECORDER_LOST_S:
            return
        if recorder.status.state is not RunState.RUNNING:
            self._set_unrecorded(recorder.status.words or f"the recorder is {recorder.status.state}")

    async def _leave(self) -> None:
        """Close the session, then end the hub. After an error, end all other processes too."""
        if self._service is not None:
            await asyncio.to_thread(self._service.bus.close)
            self._service = None
        for process in self.processes:
            self.processes.end(process, GATEWAY_GRACE_S)
        await self.processes.wait_or_kill(self.processes, GATEWAY_GRACE_S)

    # ------------------------------------------------------------------ processes

    def _populate(self) -> None:
        if self._spec.record:
            self.processes.add(RECORDER, ProcessKind.RECORDER, spec.recorder_command(self._spec, self.endpoint))
            self._recorded_from = self._recorder_heard_at = self.processes.now + RECORDER_START_TIMEOUT_S
        if self._spec.simulated:
            command = spec.simulator_command(self._spec, self.processes.directory, self.endpoint)
            self.processes.add(SIMULATOR_PROCESS, ProcessKind.SIMULATOR, command)
        for car in self._spec.cars.values():
            self._add_car(car)
        if self._spec.console:
            self.processes.add(CONSOLE, ProcessKind.CONSOLE, spec.console_command(self._spec, self.endpoint))
        if command := self._coordinator(self._spec):
            self.processes.add(COORDINATOR, ProcessKind.COORDINATOR, command)

    def _add_car(self, car: CarProcessSpec) -> None:
        """Start or restart a car's gateway. Do nothing for a simulated car that has no link yet."""
        self.rows.setdefault(car.name, CarStatus(car.name))
        link = self._sim_links.get(car.name) if car.link == spec.SIMULATED else car.link
        if link is not None:
            self._shutdown.recall(car.name)
            self.processes.add(
                car.name, ProcessKind.GATEWAY, spec.gateway_command(self._spec, car, link, self.endpoint)
            )

    def _coordinator(self, fleet_spec: FleetSpec) -> tuple[str, ...]:
        """Return the coordinator's command. Empty if there is no plan. Raises OSError."""
        if fleet_spec.plan is None:
            return ()
        return self._coordinator_of(fleet_spec, fleet_spec.plan_text)

    def _coordinator_of(self, fleet_spec: FleetSpec, text: str) -> tuple[str, ...]:
        # The coordinator gets copies. Edits of the user's files take effect after a checked reload.
        plan = write_copy(self.processes.directory, "plan", text)
        listed = write_copy(self.processes.directory, "fleet", spec.coordinator_fleet_file(fleet_spec))
        return spec.coordinator_command(fleet_spec, plan, listed, self.endpoint)

    def _on_plan(self, plan: pb.Plan) -> None:
        """Update the coordinator's command, so that a plan from the bus survives a restart until the next reload."""
        coordinator = self.processes.get(COORDINATOR)
        # A coordinator that is ending publishes its old plan. During a reload, the reload sets the command.
        if coordinator is None or coordinator.status.state is not RunState.RUNNING or self._reloading.locked():
            return
        given = plan.text != self._spec.plan_text
        try:
            command = self._coordinator_of(self._spec, plan.text)
        except OSError as error:
            if given:
                words = f"is in force, but cannot be saved: a restarted coordinator will not know it ({error.strerror})"
                self._say("process", COORDINATOR, f"plan {plan.version} {words}")
            return
        if command != coordinator.command:
            coordinator.command = command
            if given:
                words = f"plan {plan.version} came over the bus. It is in force until `fleet reload`."
                self._say("process", COORDINATOR, words)

    async def _set_plan(self, service: SupervisorService, old: FleetSpec, command: tuple[str, ...]) -> str:
        """Make the coordinator follow the spec after a reload. Return words about changes of the plan."""
        coordinator = self.processes.get(COORDINATOR)
        if not command or coordinator is None:
            if command:
                self.processes.add(COORDINATOR, ProcessKind.COORDINATOR, command)
                return "the fleet has a plan now"
            self.processes.remove(COORDINATOR, SERVICE_EXIT_TIMEOUT_S)
            return "the fleet has no plan any more. Cars keep their modes." if coordinator is not None else ""
        text = self._spec.plan_text
        words = "" if text == old.plan_text else "the plan has changed"
        in_force = None
        if coordinator.status.state is RunState.RUNNING:
            in_force = await asyncio.to_thread(service.plan_in_force)
        if in_force is not None and in_force.text not in (text, old.plan_text):
            words = f"{self._spec.plan} replaces plan {in_force.version}, which came over the bus"
        is_in_force = in_force is not None and in_force.text == text
        if (
            in_force is not None
            and (old.listed, old.people) == (self._spec.listed, self._spec.people)
            and (is_in_force or await asyncio.to_thread(service.send_plan, text))
        ):
            coordinator.command = command
        else:
            # A coordinator that rejected its arguments before is restarted, too.
            self.processes.add(
                COORDINATOR, ProcessKind.COORDINATOR, command, restart=not is_in_force and in_force is not None
            )
        return words

    # ------------------------------------------------------------------ polling

    async def _turn(self) -> None:
        now = self.processes.now
        linked = self._service is not None and self._service.bus.connected
        if linked and self._linked_since is None:
            self._linked_since = now
        elif not linked and self._linked_since is not None:
            self._linked_since, self._unlinked_since = None, now
        await self._check_hub(now, linked=linked)
        self._check_recorder(now)
        self._shutdown.turn(now)
        await self.processes.turn(self._listening_since, self._may_start, self._may_move)
        shown = [(process.name, process.status.state, process.status.restarts) for process in self.processes]
        if self._service is not None and shown != self._shown:
            self._shown = shown
            self._service.publish(self.status())

    def _listening_since(self, process: ManagedProcess) -> float | None:
        if process.kind is ProcessKind.HUB:
            return 0.0 if self._service is not None else None
        return self._linked_since

    def _may_move(self, process: ManagedProcess) -> bool:
        """Return True if a gateway's car may be moving. Only a message of its gateway can exclude that."""
        row = self.rows.get(process.name)
        return process.kind is ProcessKind.GATEWAY and (row is None or row.state.safety.motors != Motors.OFF)

    def _exists(self, car: str) -> bool:
        """Return True unless the car is simulated and its simulator has ended."""
        simulator = self.processes.get(SIMULATOR_PROCESS)
        fleet_spec = self._spec.cars.get(car)
        simulated = fleet_spec is not None and fleet_spec.link == spec.SIMULATED
        return not simulated or (simulator is not None and simulator.status.alive)

    def _may_start(self, process: ManagedProcess) -> bool:
        if process.kind is ProcessKind.HUB or self._shutdown.may_start(process.name):
            return True
        recorded = process.kind in {ProcessKind.GATEWAY, ProcessKind.COORDINATOR}
        waits = recorded and self.processes.now < self._recorded_from
        return not waits and not self._shutdown_requested.is_set()

    # ------------------------------------------------------------------ callbacks

    @property
    def options(self) -> str:
        """The options that select this fleet in a command."""
        return fleet_options(None if self.endpoint == resolve_endpoint() else self.endpoint, self._spec.fleet)

    def _on_exit(self, process: ManagedProcess, requested: bool) -> None:  # noqa: FBT001 - called by ProcessSet
        if process.kind is ProcessKind.SIMULATOR:
            self._sim_asked.clear()
            remove_links(self.processes.directory)
        if process.kind is ProcessKind.RECORDER and requested and process.code != 0:
            self._set_unrecorded(process.why or f"the recorder ended with exit code {process.code}")
        if process.kind is not ProcessKind.GATEWAY:
            return
        row = self.rows.get(process.name)
        self._shutdown.on_exit(process)
        if row is not None:
            row.reset()
        if self._shutdown.may_start(process.name):
            return
        if process.leaving:
            self.rows.pop(process.name, None)
        elif requested and process.code != 0 and process.status.state is RunState.WAITING:
            self._say("process", process.name, f"ended without stopping its car: {process.why or process.status.words}")

    def _on_message(self, car: str, topic: str, value: Any) -> None:
        row = self.rows.get(car)
        if car == RECORDER:
            if self.processes.on_heartbeat(RECORDER):
                self._recorded_from = self.processes.now
            self._recorder_heard_at = self.processes.now
            self._drops[value.session] = sum(value.drops.values())
            self._session = "" if value.state == RecorderState.STOPPED else value.session
            over = ""
            if value.state == RecorderState.CLOSED:
                over = "closed, and some of what waited is lost" if value.drops else "what waited is written"
            self._set_unrecorded(why_unrecorded(value), over)
        elif car == COORDINATOR:
            self._on_plan(value)
        elif row is not None and topic == "state/health":
            # A late message of an earlier process is not a heartbeat of its successor.
            if self.processes.on_heartbeat(car, value.pid):
                row.reset(value.boot_id)
        elif row is not None:
            if topic == "state/safety" and not row.safety_received:
                row.safety_received = True
                if words := describe_old_stops(car, value, self._began_wall_s):
                    self._say("hold", car, words)
            if words := row.take(topic, value, time.monotonic()):
                self._say("car", car, words)
            if topic == "event/log":
                self._say("log", car, row.event)

    @property
    def _lost(self) -> str:
        """Return why not everything was recorded. Empty if the recorder could keep everything that reached it."""
        dropped = sum(self._drops.values())
        words = f"the recorder dropped {dropped} messages (`fleet sessions verify` lists them)" if dropped else ""
        return self._unrecorded or words

    def _set_unrecorded(self, why: str, over: str = "") -> None:
        """Report once that nothing is recorded any more, and once that everything is recorded again. Cars keep driving.

        `over` is the reason if recording has ended for good, and empty if it continues.
        """
        if bool(why) is not bool(self._unrecorded):
            self._say("process", RECORDER, f"NOT RECORDED: {why}" if why else over or "records again")
        self._unrecorded = why

    def _on_line(self, process: ManagedProcess, line: str) -> bool:
        """Handle a line of a process's stdout. Return False for a heartbeat, which is not logged."""
        try:
            values = json.loads(line)
        except ValueError:
            values = None
        if not isinstance(values, dict):
            return True  # the line is text for a person
        if process.kind is ProcessKind.RECORDER:
            self._session = values["session"]
            self._say("process", RECORDER, _describe_recording(values))
        elif process.kind is ProcessKind.COORDINATOR:
            self._say("decision", values["subject"], f"{values['decided']}, because: {values['why']}")
        elif process.kind is ProcessKind.CONSOLE:
            self._console = values["console"]
            if self.processes.on_heartbeat(CONSOLE):
                self._say("process", CONSOLE, f"serves {self._console}")
            return False
        if process.kind is not ProcessKind.SIMULATOR:
            return True
        self.processes.on_heartbeat(SIMULATOR_PROCESS)
        if "link" in values and values.get("car") in self._spec.cars:
            self._sim_links[values["car"]] = values["link"]
            if not self._shutdown_requested.is_set():
                self._add_car(self._spec.cars[values["car"]])
        elif "ok" in values and self._sim_asked:
            if not self._sim_asked.popleft():
                return False
            self._say("simulator", SIMULATOR_PROCESS, line)
        return True

    async def _heartbeats(self, service: SupervisorService) -> None:
        """Query simulator and coordinator, which send no heartbeats, and publish the status."""
        question = json.dumps({"car": next((car.name for car in self._spec.simulated), ""), "ask": "truth"})
        asking: asyncio.Future[bool] | None = None
        while True:
            simulator, coordinator = self.processes.get(SIMULATOR_PROCESS), self.processes.get(COORDINATOR)
            if simulator is not None and simulator.child is not None and simulator.status.alive:
                self._sim_asked.append(False)
                simulator.child.write_line(question)
            if asking is not None and asking.done():
                if asking.result():
                    self.processes.on_heartbeat(COORDINATOR)
                asking = None
            if coordinator is not None and coordinator.status.alive and asking is None:
                asking = asyncio.ensure_future(asyncio.to_thread(service.coordinator_answers))
            service.publish(self.status())
            await asyncio.sleep(STATUS_INTERVAL_S)

    # ------------------------------------------------------------------ shutdown

    async def _end_all(self, service: SupervisorService) -> None:
        """Shut down in order: coordinator and pages (they would start cars again), cars, recorder, simulator."""
        self._state = RunState.ENDING
        service.publish(self.status())
        gateways = self.processes.of(ProcessKind.GATEWAY)
        movers = self.processes.of(ProcessKind.COORDINATOR, ProcessKind.CONSOLE)
        for process in movers:
            self.processes.end(process, SERVICE_EXIT_TIMEOUT_S)
        stop_query = asyncio.ensure_future(asyncio.to_thread(service.stop_all))
        await asyncio.wait([stop_query], timeout=STOP_QUERY_TIMEOUT_S)
        for process in gateways:
            self._shutdown.begin(process)
        await self._until_ended([*gateways, *movers])
        for kind, grace in (
            (ProcessKind.RECORDER, RECORDER_EXIT_TIMEOUT_S),
            (ProcessKind.SIMULATOR, SERVICE_EXIT_TIMEOUT_S),
        ):
            for process in self.processes.of(kind):
                self.processes.end(process, grace)
                await self._until_ended([process])
        await asyncio.wait([stop_query], timeout=SERVICE_EXIT_TIMEOUT_S)
        lost = f"; not everything was recorded: {self._lost}" if self._lost else ""
        self._say("end", SELF, f"{describe_end(self._shutdown.results)}{lost}")

    async def _until_ended(self, processes: list[ManagedProcess]) -> None:
        while self._shutdown.pending or any(process.status.alive for process in processes):
            if self.processes.now > self._tries_until:
                self._tries_until = inf
                self._shutdown.hurry()
            await self._turn()
            await asyncio.sleep(SUPERVISOR_POLL_INTERVAL_S / 2)

    # ------------------------------------------------------------------ commands

    @property
    def colors(self) -> Mapping[str, str]:
        """The color of each car, as #rrggbb."""
        return self._spec.colors

    def status(self) -> pb.Supervision:
        """Return the status of the supervisor and its processes."""
        now = self.processes.now
        message = pb.Supervision(
            state=self._state,
            host=socket.gethostname(),
            pid=os.getpid(),
            uptime_s=time.monotonic() - self._began,
            fleet_file=self._source,
            directory=str(self.processes.directory),
            became=self._shutdown.results,
            missing=self.missing(),
            session=self._session,
            groups={name: ",".join(cars) for name, cars in self._spec.groups.items()},
            colors=self._spec.colors,
            unrecorded=self._lost if self._state is RunState.ENDED else self._unrecorded,
        )
        for process in self.processes:
            life = process.status
            shown = message.processes.add(name=process.name, kind=process.kind, state=life.state, words=life.words)
            shown.restarts, shown.since_s = life.restarts, now - life.since if life.since else 0.0
            if process.child is not None and life.alive:
                shown.pid = process.child.pid
        return message

    def _refusal(self, person: str) -> str:
        """Return why a person with a certificate may not end or reload the fleet, or an empty text if they may."""
        return fleet_refusal(people_table(self._spec.people), person) if self._spec.people is not None else ""

    async def _down(self, sender: str) -> str:
        self.end(f"fleet down by {name_of(sender)}", CAR_STOP_RETRY_S)
        return "stopping every car, then closing the recording"

    async def _reload(self, sender: str) -> str:
        """Read the spec again and apply it as far as possible. Return the changes in words.

        Raises CommandRefused if nothing was changed, RestartNeeded if only a part was.
        """
        async with self._reloading:
            return await self._reload_alone(sender)

    async def _reload_alone(self, sender: str) -> str:
        try:
            new = await asyncio.to_thread(self._read)
        except BadFile as error:
            raise CommandRefused(f"{error}\nNothing was changed.") from None
        except ValueError as error:
            raise CommandRefused(f"nothing was changed: {error}") from None
        if self._shutdown_requested.is_set():
            raise CommandRefused("nothing was changed: the fleet is ending")
        old, found = self._spec, compare(self._spec, new)
        try:
            command = self._coordinator(found.spec)  # this may fail, so do it before any change
        except OSError as error:
            why = f"the coordinator's copies cannot be written in {self.processes.directory}: {error.strerror}"
            raise CommandRefused(f"nothing was changed: {why}") from None
        words = list(found.words)
        self._spec = found.spec
        for name in found.removed:
            process = self.processes.get(name)
            if process is not None:
                process.leaving = True
                self._shutdown.begin(process)
                self.processes.forget(process)
            if self.processes.get(name) is None:
                self.rows.pop(name, None)
        for name in found.restarted:
            self._add_car(self._spec.cars[name])
        assert self._service is not None  # this command came through the service
        if planned := await self._set_plan(self._service, old, command):
            words.append(planned)
        if found.needs_restart:
            words.append(f"cannot change while the fleet runs: {', '.join(found.needs_restart)}")
        for line in words:
            self._say("process", SELF, f"reload by {name_of(sender)}: {line}")
        if found.needs_restart:
            advice = f"Restart the fleet: `fleet down`, `fleet up {shlex.quote(self._source)}`."
            raise RestartNeeded("\n".join([*words, *found.spec.warnings, advice]))
        return "\n".join([*(words or ["nothing has changed"]), *found.spec.warnings])

    def _say(self, what: str, name: str, words: str) -> None:
        words = complete_hints(words, self.options)
        if self._log is not None and what not in _LOGGED_ELSEWHERE:
            self._log.add(f"{name}: {words}", time.time())
        self._on_event(SupervisorEvent(what, name, words))


def _describe_recording(status: Mapping[str, Any]) -> str:
    if status["state"] != RecorderState.CLOSED:
        return f"recording to {status['session']}"
    lost = sum(status["drops"].values()) + sum(status["missed"].values())
    return f"recording closed: {status['session']}, {status['messages']} messages, {lost} lost"
