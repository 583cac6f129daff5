"""The other gateways of a fleet: what is meant for all is passed on to them, and fleet-wide e-stops are united.

Each gateway serves its own car; only an e-stop (and its end) concerns those of others. They are asked, not subscribed
to: with fifty cars that would be 2,500 states a second.
"""

import asyncio
import logging
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from gateway.control.commands import Command, EmergencyStop, Resume
from gateway.control.safety import Estop, PersistedSafety
from schemas import bus, keys, messages, topics
from schemas.gen import fleet_v1_pb2 as pb

TOGETHER_S: Final = 0.2
"""Gateways that come within this time are asked together for the e-stops that they know of."""
AGAIN_S: Final = 0.5
"""One that did not answer is asked again after this, then twice this...: it may be starting, and know of an e-stop that
nobody else knows."""
SELDOM_S: Final = 30.0
"""... and so seldom in the end."""
CALM_S: Final = 1.0
"""While gateways come on and on, they are asked ever more seldom, down to every `LONGEST_TOGETHER_S`; after so long
without one that came, at once again."""
LONGEST_TOGETHER_S: Final = 3.0
MANY: Final = 8
"""Maximum gateways that are asked one by one. One query that all answer is cheaper for more of them."""
ANSWERS_PER_S: Final = 400.0
"""Maximum answers per second, all gateways together, when they come back at once.

When a hub comes back every gateway asks all others: a hundred are 10,000 answers. If they ask in one instant, answers
come too late and are asked for again, which keeps two processors busy for more than a minute. An e-stop that is asked
for meanwhile does not wait for this: its gateway passes it on at once.
"""

log = logging.getLogger("gateway")

Unite = Callable[[Sequence[Estop], Sequence[str], str], object]
"""Hears e-stops in force, ids of those that ended, and the car whose gateway knows them."""


class EstopSync:
    """Asks the other gateways of `fleet`; made and used in the loop, the bus is asked on threads."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        self._passing_on: set[asyncio.Task[None]] = set()
        self._came = asyncio.Event()
        self._alive: set[str] = set()
        self._due: set[str] = set()
        """Gateways that came and have not answered since."""

    def changed(self, changes: Mapping[str, bool]) -> None:
        """Take that gateways of the fleet came or went."""
        for name, alive in changes.items():
            if name == self._car:
                continue
            if alive:
                self._alive.add(name)
                self._due.add(name)
                self._came.set()
            else:
                self._alive.discard(name)
                self._due.discard(name)

    def ask_soon(self) -> None:
        """Ask all: there may be fleet-wide e-stops that this gateway does not know."""
        self._due |= self._alive
        self._came.set()

    def pass_on(self, command: Command, before: PersistedSafety, now: PersistedSafety) -> None:
        """What was asked of this car alone and is meant for the fleet: ask all, under the same id."""
        fleet_wide = {estop.id for estop in before.estops if estop.fleet_wide}
        payload: pb.EstopCommand | pb.ResumeCommand
        match command.what:
            case EmergencyStop(why, True):
                payload = pb.EstopCommand(why=why, scope="fleet")
            case Resume(ids) if over := sorted(fleet_wide & set(ids) & set(now.ended)):
                payload = pb.ResumeCommand(ids=over)
            case _:
                return
        payload.sender, payload.kind, payload.id = command.sender.name, command.sender.kind, command.id
        key = keys.command_key(self._fleet, "*", command.verb)
        encoding = messages.encoding_of(topics.COMMANDS[command.verb])
        asking = asyncio.to_thread(self._ask_all, key, payload.SerializeToString(), encoding)
        task = asyncio.ensure_future(asking)
        self._passing_on.add(task)
        task.add_done_callback(self._passing_on.discard)

    def _ask_all(self, key: str, payload: bytes, encoding: str) -> None:
        """On a thread; what each car answers is in its own records."""
        for _ in self._bus.query(key, payload=payload, encoding=encoding):
            pass

    async def keep_united(self, unite: Unite) -> None:
        """Fleet-wide e-stops, in force and ended, are taken over from whoever comes onto the bus; until cancelled."""
        again_s, again = AGAIN_S, None
        together_s, first = TOGETHER_S, True
        while True:
            try:
                async with asyncio.timeout(CALM_S):
                    await self._came.wait()
            except TimeoutError:
                together_s = TOGETHER_S
                await self._came.wait()
            await asyncio.sleep(together_s)
            together_s = min(2 * together_s, LONGEST_TOGETHER_S)
            if len(self._due) > MANY and not first:
                await asyncio.sleep(len(self._due) ** 2 / ANSWERS_PER_S * random.random())  # noqa: S311 - jitter, no secret
            first = False
            self._came.clear()
            for answer in await asyncio.to_thread(self._ask, sorted(self._due)):
                try:
                    shown: Any = answer.message()
                except (messages.BadPayload, KeyError) as error:
                    log.warning("%s: no state of a gateway of this fleet: %s", answer.key, error)
                    continue
                unite([_estop(each) for each in shown.estops], shown.ended, shown.car)
                self._due.discard(shown.car)
            if again is not None:
                again.cancel()
            if self._due:
                again = asyncio.get_running_loop().call_later(again_s, self._came.set)
            again_s = min(2 * again_s, SELDOM_S) if self._due else AGAIN_S

    def _ask(self, names: Sequence[str]) -> list[bus.Sample]:
        """Return the states of these gateways; on a thread.

        If each gateway asked all others whenever one came, a hundred that start would have 300,000 answers to give.
        """
        asked = names if len(names) <= MANY else ("*",)
        selectors = [keys.topic_key(self._fleet, name, "state/safety") for name in asked]
        return [
            answer for selector in selectors for answer in self._bus.query(selector) if isinstance(answer, bus.Sample)
        ]


def _estop(shown: pb.Estop) -> Estop:
    at_ns = shown.stamp.seconds * 1_000_000_000 + shown.stamp.nanos
    return Estop(shown.id, shown.by, shown.why, at_ns, shown.scope == "fleet")
