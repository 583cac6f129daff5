"""A gateway's doors on the bus: its queryables, its drive subscription and its token, and whether another has them.

They are declared before the gateway has imported the rest of itself, half of what a start takes: a car is on the bus at
once, and what is asked meanwhile waits for `attach`. So nothing heavy is imported here.

Commands come before answers: a command waits for a turn of the loop, a question of values for those before it, and a
question of the past for the task that answers one of them at a time.
"""

import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import zenoh

from schemas import bus, keys
from schemas.topics import STOPS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Mapping

FAMILIES: Final = ("sensor", "state")
STREAM_WAITING: Final = 32
"""Drives of streams that may wait: of a flood the newest, and few, so that a stop never waits for long behind them."""
COMMANDS_WAITING: Final = 128
STOPS_WAITING: Final = 128
"""Stops find room when other commands find none: they wait in one order, as a drive must not follow its own stop."""
LARGE_WAITING: Final = 4
"""Commands that are too large to be read, and wait to be refused: each keeps its payload in memory."""
VALUES_WAITING: Final = 256
HISTORIES_WAITING: Final = 8
"""Questions of the past that may wait: each takes up to a second of work, and every answer of it memory."""
ANSWERS_S: Final = 3.0
"""Who serves the car and is held up answers within it, or is off the bus: Zenoh's lease is 2 s."""


class AlreadyServed(Exception):
    """Another gateway serves this car; the text names it."""


class CarService:
    """What one gateway has declared. Raises AlreadyServed if another gateway answers for the car."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        self.refuse(self.others())
        self._commands: bus.Handover[tuple[zenoh.Query, str]] = bus.Handover(limit=COMMANDS_WAITING)
        self._large: bus.Handover[tuple[zenoh.Query, str]] = bus.Handover(limit=LARGE_WAITING)
        self._stream: bus.Handover[bus.Sample] = bus.Handover(limit=STREAM_WAITING, newest=True)
        self.values: bus.Backlog[tuple[str, zenoh.Query]] = bus.Backlog(VALUES_WAITING)
        """Questions of the latest values: the family, and the query."""
        self.histories: bus.Backlog[tuple[str, zenoh.Query]] = bus.Backlog(HISTORIES_WAITING)
        """Questions of earlier values."""
        self._senders: bus.Latest[bool] = bus.Latest()
        self._cars: bus.Latest[bool] = bus.Latest()
        # Queryables first, then the token: whoever sees the token gets an answer.
        for family in FAMILIES:
            # A query on `fleet/**` reaches both: each answers for its own family only.
            opened.queryable(f"{fleet}/{car}/{family}/*", partial(self._asked, family))
        opened.queryable(keys.command_key(fleet, car, "*"), self._command, too_large=self._too_large)
        opened.subscribe(keys.command_key(fleet, car, "drive"), self._stream, largest=bus.LARGEST_PAYLOAD)
        opened.watch_tokens(f"{fleet}/{keys.OPERATOR}/*", self._sender)
        opened.token(keys.car_token(fleet, car))
        opened.watch_tokens(keys.car_token(fleet, "*"), self._neighbour)

    def attach(
        self,
        loop: "asyncio.AbstractEventLoop",
        *,
        values: "asyncio.Event",
        histories: "asyncio.Event",
        command: "Callable[[tuple[zenoh.Query, str]], object]",
        streamed: "Callable[[bus.Sample], object]",
        senders: "Callable[[Mapping[str, bool]], object]",
        cars: "Callable[[Mapping[str, bool]], object]",
    ) -> None:
        """Say who takes what comes, and came: (command, why it is not read), drives, whether each name is alive.

        `values` and `histories` are set when there are questions.
        """
        self.values.attach(loop, values)
        self.histories.attach(loop, histories)
        self._commands.attach(loop, command)
        self._large.attach(loop, command)
        self._stream.attach(loop, streamed)
        self._senders.attach(loop, senders)
        self._cars.attach(loop, cars)

    @property
    def dropped(self) -> int:
        """How much came that nobody could take in time."""
        handovers = (self._commands, self._large, self._stream, self.values, self.histories, self._senders, self._cars)
        return sum(handover.dropped for handover in handovers)

    def others(self) -> list[Any]:
        """The fleet.v1.Health of every other gateway that answers for this car."""
        found: list[Any] = []
        deadline, busy = time.monotonic() + ANSWERS_S, True
        while busy and time.monotonic() < deadline:
            busy = False
            for answer in self._bus.query(keys.topic_key(self._fleet, self._car, "state/health"), timeout_s=ANSWERS_S):
                if isinstance(answer, bus.Failure):
                    busy = busy or answer.words == bus.BUSY  # there is one, and it will say who it is
                    continue
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

    def _asked(self, family: str, query: zenoh.Query) -> bool:
        """On a Zenoh thread."""
        of_the_past = any(each in query.parameters for each in ("_time", "last"))
        return (self.histories if of_the_past else self.values)((family, query))

    def _command(self, query: zenoh.Query) -> bool:
        """On a Zenoh thread."""
        return self._commands((query, ""), reserve=STOPS_WAITING if _is_stop(query) else 0)

    def _too_large(self, query: zenoh.Query, words: str) -> bool:
        """On a Zenoh thread."""
        if _is_stop(query):
            return self._commands((query, words), reserve=STOPS_WAITING)
        return self._large((query, words))

    def _sender(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """On a Zenoh thread."""
        self._senders(key.rpartition("/")[2], alive)

    def _neighbour(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """On a Zenoh thread."""
        self._cars(key.rpartition("/")[2], alive)


def _is_stop(query: zenoh.Query) -> bool:
    return str(query.key_expr).rpartition("/")[2] in STOPS
