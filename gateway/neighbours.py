"""The other gateways of a fleet: what is meant for all is passed on to them, and fleet-wide e-stops are united.

Each gateway serves its own car; only an e-stop (and its end) concerns those of others. They are asked, not subscribed
to: with fifty cars that would be 2,500 states a second.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from gateway.control.records import Command, EmergencyStop, Resume
from gateway.control.safety import Estop, Kept
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
"""While gateways come on and on, all are asked ever more seldom, down to every `LONGEST_TOGETHER_S`; after so long
without one that came, at once again."""
LONGEST_TOGETHER_S: Final = 3.0

log = logging.getLogger("gateway")

Unite = Callable[[Sequence[Estop], Sequence[str], str], object]
"""Hears e-stops in force, ids of those that ended, and the car whose gateway knows them."""


class Neighbours:
    """Asks the other gateways of `fleet`; made and used in the loop, the bus is asked on threads."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        self._passing_on: set[asyncio.Task[None]] = set()
        self._came = asyncio.Event()

    def changed(self, changes: Mapping[str, bool]) -> None:
        """Gateways of the fleet came or went."""
        if any(alive and name != self._car for name, alive in changes.items()):
            self.ask_soon()

    def ask_soon(self) -> None:
        """There may be fleet-wide e-stops that this gateway does not know."""
        self._came.set()

    def pass_on(self, command: Command, before: Kept, now: Kept) -> None:
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
        key = keys.topic_key(self._fleet, "*", "state/safety")
        again_s, together_s = AGAIN_S, TOGETHER_S
        while True:
            try:
                async with asyncio.timeout(CALM_S):
                    await self._came.wait()
            except TimeoutError:
                together_s = TOGETHER_S
                await self._came.wait()
            await asyncio.sleep(together_s)
            together_s = min(2 * together_s, LONGEST_TOGETHER_S)
            self._came.clear()
            unanswered = False
            for answer in await asyncio.to_thread(lambda: list(self._bus.query(key))):
                if not isinstance(answer, bus.Sample):
                    unanswered = True
                    continue
                try:
                    shown: Any = answer.message()
                except (messages.BadPayload, KeyError) as error:
                    log.warning("%s: no state of a gateway of this fleet: %s", answer.key, error)
                    continue
                unite([_estop(each) for each in shown.estops], shown.ended, shown.car)
            if unanswered:
                asyncio.get_running_loop().call_later(again_s, self.ask_soon)
            again_s = min(2 * again_s, SELDOM_S) if unanswered else AGAIN_S


def _estop(shown: pb.Estop) -> Estop:
    at_ns = shown.stamp.seconds * 1_000_000_000 + shown.stamp.nanos
    return Estop(shown.id, shown.by, shown.why, at_ns, shown.scope == "fleet")
