"""Syncs fleet-wide e-stops and pauses between the gateways of a fleet.

Each gateway serves its own car. Only fleet-wide e-stops, pauses, and their ends concern the other gateways. A gateway
queries the others. It does not subscribe to their states: with fifty cars, that would be 2,500 states a second.
"""

import asyncio
import contextlib
import logging
import random
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Any, Final

from gateway.control.commands import Answer, Command, EmergencyStop, Pause, Resume, Unpause
from gateway.control.safety_state import PersistedSafety, Safety
from schemas import bus, keys, messages
from schemas.backoff import backoff_s
from schemas.commands import COMMANDS
from schemas.gen import fleet_v1_pb2 as pb
from schemas.limits import MAX_NAME_LENGTH
from schemas.rights import estops_of, pauses_of
from schemas.words import Reason, Scope

BATCH_DELAY_S: Final = 0.2
"""Delay before a query, so that gateways that start together are queried together."""
MAX_BATCH_DELAY_S: Final = 3.0
"""Maximum of this delay, which doubles while more gateways start. Before a query to all gateways that is not the first
one, a random delay is added (see `ANSWERS_PER_S`)."""
BATCH_RESET_S: Final = 1.0
"""Time without a new gateway after which the delay begins at `BATCH_DELAY_S` again."""
FIRST_RETRY_S: Final = 0.5
"""Delay before the first retry of gateways that did not answer. It doubles with each retry."""
MAX_RETRY_S: Final = 10.0
"""Maximum retry interval. Retries never end, because a starting gateway may know an e-stop that no other one knows."""
SYNC_QUERY_TIMEOUT_S: Final = 2.5
"""Time for the answers to one query. When two sites are linked again, all their gateways query each other, which fills
the link. With a timeout of 1 s and 5 % of the packets lost, an e-stop needed 2 to 17 s from one site to the other."""
ROUND_S: Final = 5.0
"""Mean interval at which one of the other gateways, drawn at random, is queried. A command to all cars may miss one
that is starting, and be too old for one that hangs. So every gateway learns in the end what any of them knows."""
MAX_SINGLE_QUERIES: Final = 8
"""Number of gateways that may always be queried one by one, whatever their share of the fleet is."""
MAX_SINGLE_SHARE: Final = 0.5
"""Maximum share of the gateways that is queried one by one. For more, one query to all gateways is cheaper."""
# After a restart of the hub, each gateway queries all others: a hundred gateways cause 10,000 answers. If all queries
# started at once, answers would time out and be requested again, and two processors would be busy for over a minute. A
# new e-stop does not wait for these queries: its gateway forwards it at once.
ANSWERS_PER_S: Final = 400.0
"""Maximum answers per second of all gateways together after a restart of the hub."""

log = logging.getLogger("gateway")

MergeSafety = Callable[[PersistedSafety, str], object]
"""Called with the e-stops and pauses, in force and ended, and the car whose gateway has sent them."""


Copy = pb.EstopCommand | pb.ResumeCommand | pb.PauseCommand | pb.UnpauseCommand


def copy_for_others(command: Command, car: str, before: PersistedSafety, now: Safety) -> Copy | None:
    """Return the command for all other gateways after one to `car` alone. None if it does not concern them.

    `before` and `now`: the state of this car before and after the command.
    """
    fleet_wide = {estop.id for estop in before.estops if estop.fleet_wide}
    copy: Copy
    match command.what:
        case EmergencyStop(why, True):
            copy = pb.EstopCommand(why=why, scope=Scope.FLEET)
        case Resume() if ended_ids := sorted(fleet_wide & set(now.ended)):
            copy = pb.ResumeCommand(ids=ended_ids)
        case Pause(why) if now.pauses != before.pauses:
            copy = pb.PauseCommand(why=why)
        case Unpause() if now.pauses != before.pauses:
            copy = pb.UnpauseCommand(ids=[each.id for each in before.pauses if each not in now.pauses])
        case _:
            return None
    copy.sender, copy.kind, copy.id = command.sender.name, command.sender.kind, command.id
    if isinstance(command.what, Resume | Unpause):
        # A car may get both this copy and the command of the sender. With one id for both, the second would be refused
        # as a duplicate.
        copy.id = f"{command.id}-{car}"[-MAX_NAME_LENGTH:]
    return copy


def concerns_fleet(command: Command, answer: Answer) -> bool:
    """Return True for a command to all gateways after which one of them may lack, or still have, what others know."""
    match command.what:
        case Pause() | Unpause() | EmergencyStop(fleet_wide=True):
            return True
        case Resume():
            return answer.reason is Reason.ESTOPPED
        case _:
            return False


class EstopSync:
    """Queries the other gateways of `fleet`. Create and use it in the loop; the queries run on threads."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        self._forwarding: set[asyncio.Task[None]] = set()
        self._changed = asyncio.Event()
        self._alive: set[str] = set()
        self._due: set[str] = set()
        """Gateways that still have to answer a query, because they started, or because `sync_soon` was called."""

    def on_tokens(self, changes: Mapping[str, bool]) -> None:
        """Record that gateways of the fleet started or ended."""
        for name, alive in changes.items():
            if name == self._car:
                continue
            if alive:
                self._alive.add(name)
                self._due.add(name)
                self._changed.set()
            else:
                self._alive.discard(name)
                self._due.discard(name)

    def sync_soon(self) -> None:
        """Query all gateways soon, because there may be fleet-wide e-stops that this gateway does not know."""
        self._due |= self._alive
        self._changed.set()

    def share(
        self, command: Command, answer: Answer, before: PersistedSafety, now: Safety, *, by_wildcard: bool
    ) -> None:
        """Let the other gateways know what a command has changed for the whole fleet.

        `by_wildcard`: its sender has addressed them, too.
        """
        if by_wildcard:
            if concerns_fleet(command, answer):
                self.sync_soon()
            return
        copy = copy_for_others(command, self._car, before, now)
        if copy is None:
            return
        key = keys.command_key(self._fleet, "*", command.verb, self._bus.identity)
        encoding = messages.encoding_of(COMMANDS[command.verb].message)
        task = asyncio.ensure_future(asyncio.to_thread(self._send_to_all, key, copy.SerializeToString(), encoding))
        self._forwarding.add(task)
        task.add_done_callback(self._forwarding.discard)

    def _send_to_all(self, key: str, payload: bytes, encoding: str) -> None:
        """Send a command to all gateways, on a thread. Ignore the answers: each car records its own."""
        # Without a link, the others learn of it when this gateway is back (`keep_synced`).
        with contextlib.suppress(bus.BusError):
            for _ in self._bus.query(key, payload=payload, encoding=encoding):
                pass

    async def keep_synced(self, merge: MergeSafety) -> None:
        """Merge the fleet-wide e-stops and the pauses of each gateway that starts, until cancelled."""
        retry: asyncio.TimerHandle | None = None
        batches, silences, first = 0, 0, True
        while True:
            if not await self._is_changed_within(BATCH_RESET_S):
                batches = 0
                if not await self._is_changed_within(2.0 * ROUND_S * random.random()):  # noqa: S311 - no secret
                    if not self._alive:
                        continue
                    self._due.add(random.choice(sorted(self._alive)))  # noqa: S311 - no secret
            batches += 1
            await asyncio.sleep(backoff_s(batches, BATCH_DELAY_S, MAX_BATCH_DELAY_S))
            if self._queries_all() and not first:
                await asyncio.sleep(len(self._due) ** 2 / ANSWERS_PER_S * random.random())  # noqa: S311 - jitter, no secret
            first = False
            self._changed.clear()
            # Query only gateways that are due. If each queried all others whenever one starts, a hundred starts would
            # cause 300,000 answers.
            names = ("*",) if self._queries_all() else sorted(self._due)
            async for answer in self._answers(names):
                self._on_state(merge, answer)
            if retry is not None:
                retry.cancel()
            silences = silences + 1 if self._due else 0
            if self._due:
                delay_s = backoff_s(silences, FIRST_RETRY_S, MAX_RETRY_S)
                retry = asyncio.get_running_loop().call_later(delay_s, self._changed.set)

    async def _is_changed_within(self, seconds: float) -> bool:
        """Return True as soon as there is a gateway to query, or False after this time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()
        return self._changed.is_set()

    def _queries_all(self) -> bool:
        """Return True if so many gateways are due that one query to all is cheaper."""
        return len(self._due) > max(MAX_SINGLE_QUERIES, MAX_SINGLE_SHARE * len(self._alive))

    def _on_state(self, merge: MergeSafety, answer: bus.Sample) -> None:
        """Merge the state of one gateway, which is not due any more."""
        try:
            state: Any = answer.message()
        except (messages.BadPayload, KeyError) as error:
            log.warning("%s: the answer is not the state of a gateway of this fleet: %s", answer.key, error)
            return
        merge(_shared(state), state.car)
        self._due.discard(state.car)

    async def _answers(self, names: Sequence[str]) -> AsyncIterator[bus.Sample]:
        """Yield each state as it arrives, because one is enough to learn of an e-stop, and the last one may be late."""
        loop, answers = asyncio.get_running_loop(), asyncio.Queue[bus.Sample | None]()
        query = asyncio.to_thread(self._query, names, lambda each: loop.call_soon_threadsafe(answers.put_nowait, each))
        asked = asyncio.ensure_future(query)
        asked.add_done_callback(lambda _: answers.put_nowait(None))
        while (answer := await answers.get()) is not None:
            yield answer
        await asked

    def _query(self, names: Sequence[str], on_state: Callable[[bus.Sample], object]) -> None:
        """Query the states of these gateways; `*` stands for all. Runs on a thread."""
        silent = 0
        for name in names:
            is_silent = True
            selector = keys.topic_key(self._fleet, name, "state/safety")
            for answer in self._bus.query(selector, timeout_s=SYNC_QUERY_TIMEOUT_S):
                if isinstance(answer, bus.Sample):
                    is_silent = False
                    on_state(answer)
            silent += is_silent
            if silent == MAX_SINGLE_QUERIES:  # ask all others at once: each silent gateway costs a timeout
                self._query(("*",), on_state)
                return


def _shared(state: pb.Safety) -> PersistedSafety:
    """Return the part of a gateway's state that concerns the other gateways."""
    return PersistedSafety(None, estops_of(state), tuple(state.ended), pauses_of(state), tuple(state.ended_pauses))
