"""A gateway's doors on the bus: its queryables, its drive subscription and its token, and whether another has them.

They are declared before the gateway has imported the rest of itself, half of what a start takes: a car is on the bus at
once, and what is asked meanwhile waits for `attach`. So nothing heavy is imported here.
"""

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import zenoh

from schemas import bus, keys

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

FAMILIES: Final = ("sensor", "state")
STREAM_WAITING: Final = 32
"""Drives of streams that may wait: of a flood the newest, and few, so that a stop never waits for long behind them."""
ANSWERS_S: Final = 3.0
"""Who serves the car and is held up answers within it, or is off the bus: Zenoh's lease is 2 s."""


class AlreadyServed(Exception):
    """Another gateway serves this car; the text names it."""


class Doors:
    """What one gateway has declared. Raises AlreadyServed if another gateway answers for the car."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        self.refuse(self.others())
        self._commands: bus.Handover[zenoh.Query] = bus.Handover(limit=256)
        self._stream: bus.Handover[bus.Sample] = bus.Handover(limit=STREAM_WAITING, newest=True)
        self._queries: bus.Handover[tuple[str, zenoh.Query]] = bus.Handover()
        self._senders: bus.Handover[tuple[str, bool]] = bus.Handover()
        self._cars: bus.Handover[tuple[str, bool]] = bus.Handover()
        # Queryables first, then the token: whoever sees the token gets an answer.
        for family in FAMILIES:
            # A query on `fleet/**` reaches both: each answers for its own family only.
            opened.queryable(f"{fleet}/{car}/{family}/*", partial(self._asked, family))
        opened.queryable(keys.command_key(fleet, car, "*"), self._commands)
        opened.subscribe(keys.command_key(fleet, car, "drive"), self._stream)
        opened.watch_tokens(f"{fleet}/{keys.OPERATOR}/*", self._sender)
        opened.token(keys.car_token(fleet, car))
        opened.watch_tokens(keys.car_token(fleet, "*"), self._neighbour)

    def attach(
        self,
        loop: "asyncio.AbstractEventLoop",
        *,
        query: "Callable[[tuple[str, zenoh.Query]], object]",
        command: "Callable[[zenoh.Query], object]",
        streamed: "Callable[[bus.Sample], object]",
        sender: "Callable[[tuple[str, bool]], object]",
        car: "Callable[[tuple[str, bool]], object]",
    ) -> None:
        """Say who takes what comes, and came: (family, query), commands, drives, (sender, alive), (car, alive)."""
        self._queries.attach(loop, query)
        self._commands.attach(loop, command)
        self._stream.attach(loop, streamed)
        self._senders.attach(loop, sender)
        self._cars.attach(loop, car)

    @property
    def dropped(self) -> int:
        """How much came that nobody could take in time."""
        handovers = (self._queries, self._commands, self._stream, self._senders, self._cars)
        return sum(handover.dropped for handover in handovers)

    def others(self) -> list[Any]:
        """The fleet.v1.Health of every other gateway that answers for this car."""
        found = []
        for answer in self._bus.query(keys.topic_key(self._fleet, self._car, "state/health"), timeout_s=ANSWERS_S):
            if isinstance(answer, bus.Sample):
                health: Any = answer.message()
                if health.boot_id != self._bus.boot_id:
                    found.append(health)
        return found

    def refuse(self, others: list[Any]) -> None:
        """Raise AlreadyServed if there is another."""
        for other in others:
            raise AlreadyServed(
                f"car {self._car} is served already, by process {other.pid} on {other.host} "
                f"(link {other.link}): stop that one first, or give this car another name"
            )

    def _asked(self, family: str, query: zenoh.Query) -> None:
        """On a Zenoh thread."""
        self._queries((family, query))

    def _sender(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """On a Zenoh thread."""
        self._senders((key.rpartition("/")[2], alive))

    def _neighbour(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """On a Zenoh thread."""
        self._cars((key.rpartition("/")[2], alive))
