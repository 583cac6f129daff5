"""The bus service of one car: its queryables, its drive subscription, its token, and the check for a second gateway.

A queryable answers queries. The token shows others that the gateway is connected (see `schemas.keys`).

The gateway declares the service before it imports the rest of its modules, because these imports take half of the time
of its start. So the car is on the bus early, and queries wait for `attach`. Do not import heavy modules here.

Commands go before queries of values: a command waits only for the next turn of the loop. Queries of the latest values
wait in a queue, and queries of the history in another one.
"""

import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from gateway.bus.sender_budgets import SenderBudgets
from schemas import bus, keys
from schemas.commands import STOPS, Verb

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Mapping

FAMILIES: Final = ("sensor", "state")
MAX_QUEUED_DRIVES: Final = 32
"""Maximum waiting drives of streams. Older ones are dropped. The number is small, so that a stop never waits long."""
MAX_QUEUED_QUERIES: Final = 128
"""Maximum waiting command queries."""
MAX_QUEUED_STOPS: Final = 128
"""Additional room for stops in the queue of commands. They have no queue of their own: a drive must not overtake the
stop that was sent before it."""
MAX_QUEUED_OVERSIZED: Final = 4
"""Maximum waiting commands that are too large and will be rejected. Each holds its payload in memory."""
MAX_QUEUED_VALUE_QUERIES: Final = 256
"""Maximum waiting queries of the latest values."""
MAX_QUEUED_HISTORY_QUERIES: Final = 8
"""Maximum waiting queries of the history. Each takes up to a second of work, and memory for every answer."""
RIVAL_TIMEOUT_S: Final = 3.0
"""Timeout for another gateway's answer. Within it, a stalled gateway answers, or loses its Zenoh lease (2 s)."""


class Request(NamedTuple):
    """One command as the bus delivered it: a query, or one sample of a stream."""

    verb: str
    payload: bytes | None
    encoding: str
    by_wildcard: bool = False
    """True if one key expression addressed several cars."""
    why_unread: str = ""
    """Why the payload was not read, or an empty text if it was."""
    identity: str = ""
    """The sender's identity, proven by a certificate. Empty on a bus without certificates."""
    sampled_ns: int | None = None
    """Zenoh timestamp of a sample, ns since the epoch. None for a query."""
    query: zenoh.Query | None = None
    """The query that waits for an answer. None for a sample."""

    @property
    def streamed(self) -> bool:
        """Return True for a sample: nobody waits for an answer."""
        return self.sampled_ns is not None


class AlreadyServed(Exception):
    """Another gateway serves this car. The text names it."""


class CarService:
    """The declarations of one gateway. Raises AlreadyServed if another gateway answers for the car."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str) -> None:
        self._bus = opened
        self._fleet = fleet
        self._car = car
        health_key = keys.topic_key(fleet, car, "state/health")
        self.singleton = bus.Singleton(opened, health_key, self._already_served, RIVAL_TIMEOUT_S)
        self.singleton.check_alone()
        self._commands: bus.Handover[Request] = bus.Handover(limit=MAX_QUEUED_QUERIES)
        self._large: bus.Handover[Request] = bus.Handover(limit=MAX_QUEUED_OVERSIZED)
        self._stream: bus.Handover[Request] = bus.Handover(limit=MAX_QUEUED_DRIVES, newest=True)
        self._budgets = SenderBudgets()
        self.values: bus.Backlog[tuple[str, zenoh.Query]] = bus.Backlog(MAX_QUEUED_VALUE_QUERIES)
        """Queries of the latest values, each with its family."""
        self.histories: bus.Backlog[tuple[str, zenoh.Query]] = bus.Backlog(MAX_QUEUED_HISTORY_QUERIES)
        """Queries of the history, each with its family."""
        self._senders: bus.Latest[bool] = bus.Latest()
        self._cars: bus.Latest[bool] = bus.Latest()
        self._poses: bus.Latest[bus.Sample] = bus.Latest(limit=1)
        # Declare the queryables before the token, because a client that sees the token must get an answer.
        for family in FAMILIES:
            # A query on `fleet/**` reaches both queryables, so each answers only for its own family.
            opened.queryable(f"{fleet}/{car}/{family}/*", partial(self._on_query, family))
        for expression in keys.command_keys(fleet, car):
            opened.queryable(expression, self._on_command, too_large=self._on_command)
        for expression in keys.command_keys(fleet, car, Verb.DRIVE):
            opened.subscribe(expression, self._on_sample, largest=bus.LARGEST_PAYLOAD, admits=self._admits)
        # A program outside the car may publish the car's pose. The gateway answers queries with it.
        pose = keys.topic_key(fleet, car, "sensor/pose")
        opened.subscribe(pose, lambda sample: self._poses(pose, sample), largest=bus.LARGEST_PAYLOAD)
        opened.watch_tokens(f"{fleet}/{keys.OPERATOR}/*", self._on_sender)
        opened.token(keys.car_token(fleet, car))
        opened.watch_tokens(keys.car_token(fleet, "*"), self._on_car)

    def attach(
        self,
        loop: "asyncio.AbstractEventLoop",
        *,
        values: "asyncio.Event",
        histories: "asyncio.Event",
        command: "Callable[[Request], object]",
        senders: "Callable[[Mapping[str, bool]], object]",
        cars: "Callable[[Mapping[str, bool]], object]",
        poses: "Callable[[Mapping[str, bus.Sample]], object]",
    ) -> None:
        """Connect the handlers. They also get the items that wait already.

        `senders` and `cars` are called with changes of tokens by name. `values` and `histories` are set when there are
        queries. `poses` is called with the newest published pose, which may be the gateway's own.
        """
        self.values.attach(loop, values)
        self.histories.attach(loop, histories)
        self._commands.attach(loop, command)
        self._large.attach(loop, command)
        self._stream.attach(loop, command)
        self._senders.attach(loop, senders)
        self._cars.attach(loop, cars)
        self._poses.attach(loop, poses)

    @property
    def dropped(self) -> int:
        """Return the number of dropped items."""
        handovers = (self._commands, self._large, self._stream, self.values, self.histories, self._senders, self._cars)
        return sum(handover.dropped for handover in handovers) + self._budgets.dropped

    def _already_served(self, other: Any) -> AlreadyServed:
        return AlreadyServed(
            f"car {self._car} already has a gateway, process {other.pid} on {other.host} "
            f"(link {other.link}): stop that gateway first, or give this car another name"
        )

    def _on_query(self, family: str, query: zenoh.Query) -> bool:
        """Queue a query of values. Runs on a Zenoh thread."""
        is_history = any(each in query.parameters for each in ("_time", "last"))
        return (self.histories if is_history else self.values)((family, query))

    def _on_command(self, query: zenoh.Query, why_unread: str = "") -> bool:
        """Queue a command, also one that is too large to be read. Runs on a Zenoh thread."""
        expression = str(query.key_expr)
        verb = expression.rpartition("/")[2]
        if "*" in verb:
            bus.refuse(query, f"{expression}: give the name of one command, not {verb}")
            return True
        request = Request(
            verb,
            query.payload.to_bytes() if query.payload is not None and not why_unread else None,
            str(query.encoding) if query.encoding is not None and not why_unread else "",
            by_wildcard="*" in expression,
            why_unread=why_unread,
            identity=keys.identity_of(expression),
            query=query,
        )
        if verb in STOPS:
            return self._commands(request, reserve=MAX_QUEUED_STOPS)
        return (self._large if why_unread else self._commands)(request)

    def _admits(self, key: str, session: str) -> bool:
        """Return True if a drive of a stream is within the budget of its sender. Runs on a Zenoh thread."""
        return self._budgets.take(key, session, time.monotonic())

    def _on_sample(self, sample: bus.Sample) -> None:
        """Queue a drive of a stream. Runs on a Zenoh thread."""
        if not sample.deleted:
            request = Request(
                Verb.DRIVE,
                sample.payload,
                sample.encoding,
                by_wildcard="*" in sample.key,
                why_unread=sample.why_unread,
                identity=keys.identity_of(sample.key),
                sampled_ns=sample.time_ns,
            )
            self._stream(request)

    def _on_sender(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """Queue a change of a sender's token. Runs on a thread of the bus."""
        self._senders(key.rpartition("/")[2], alive)

    def _on_car(self, key: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """Queue a change of a gateway's token. Runs on a thread of the bus."""
        self._cars(key.rpartition("/")[2], alive)
