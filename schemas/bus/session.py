"""The only place that opens a Zenoh session: publications, subscriptions, queries and liveliness tokens."""

import os
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, Self

import zenoh

from schemas.bus.endpoint import accepts, client_config, ensure_hub, resolve_endpoint
from schemas.bus.errors import BusError, NoFleet
from schemas.bus.publisher import ZENOH_QOS, Publisher
from schemas.bus.replies import BUSY, refuse
from schemas.bus.sample import Failure, Sample, sample_of, unread
from schemas.topics import Qos, Topic

_HISTORY_S: Final = 2.0
"""The longest that a watch waits for what is there already: for a token that goes in this very moment.

On a busy machine what is there may take a while to be told, and who asks meanwhile would be told that there is less."""

_ANSWERS: Final = 1 << 16
"""Answers that wait for who asked: beyond them the link stands still, and what comes is dropped on the way."""


class Bus:
    """One Zenoh session. Close it (`with`): an open session with callbacks keeps the interpreter from ending."""

    def __init__(self, session: zenoh.Session, endpoint: str) -> None:
        self._session = session
        self._kept: list[Any] = []
        self._lock = threading.Lock()
        self._alive: dict[str, set[str]] = {}
        """By watched expression."""
        self.endpoint = endpoint
        self.boot_id = os.urandom(16).hex()

    @classmethod
    def open(cls, endpoint: str | None = None, *, start_hub: bool = False, timeout_s: float = 5.0) -> Self:
        """Open a session at the endpoint (see `resolve_endpoint`).

        `start_hub`: for those who must run: start a hub if there is none. Without it a missing hub raises NoFleet.
        """
        where = resolve_endpoint(endpoint)
        if start_hub:
            ensure_hub(where)
        elif not accepts(where):
            raise NoFleet(
                f"no fleet is running at {where}: start one (`gateway run`, or `make demo` to see one), "
                "or name another with --connect"
            )
        try:
            session = zenoh.open(client_config(where, timeout_s))
        except zenoh.ZError as error:
            raise BusError(
                f"what listens at {where} is no Zenoh router, or does not answer: name the fleet's with --connect"
            ) from error
        return cls(session, where)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare everything and close the session."""
        self._kept.clear()
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type

    @property
    def id(self) -> str:
        """The session's Zenoh id, for ordering two of a kind."""
        return str(self._session.zid())

    @property
    def connected(self) -> bool:
        """Whether there is a link to a router now."""
        return bool(self._session.info.routers_zid())

    def publisher(self, key: str, topic: Topic, source: str) -> Publisher:
        """Declare a publisher of `topic` under `key`; `source` becomes the messages' `car`."""
        return Publisher(self._session, key, topic, source, self.boot_id)

    def subscribe(
        self, expression: str, callback: Callable[[Sample], object], *, largest: int | None = None
    ) -> zenoh.Subscriber[None]:
        """Call back for every publication, on a Zenoh thread: hand over and return.

        A payload of more than `largest` bytes is not read (see `Sample.unread`).
        """
        subscriber = self._session.declare_subscriber(expression, lambda sample: callback(sample_of(sample, largest)))
        self._kept.append(subscriber)
        return subscriber

    def subscribe_channel(self, expression: str, capacity: int) -> zenoh.Subscriber[Any]:
        """Publications wait in a channel for `try_recv`, without Python on their way into it.

        For who takes everything (the recorder): per message half the cost of a callback. The taker must come often: a
        full channel stalls the whole session.
        """
        subscriber = self._session.declare_subscriber(expression, zenoh.handlers.FifoChannel(capacity))
        self._kept.append(subscriber)
        return subscriber

    def queryable(
        self,
        expression: str,
        callback: Callable[[zenoh.Query], object],
        *,
        too_large: Callable[[zenoh.Query, str], object] | None = None,
    ) -> zenoh.Queryable[None]:
        """Call back for every query, on a Zenoh thread: hand over and return False if it found no room.

        Such a query is answered as BUSY. One in which something is too large is refused and its payload is not read, or
        handed to `too_large` with the words.
        """

        def take(query: zenoh.Query) -> None:
            words = unread(query)
            if words and too_large is None:
                refuse(query, words)
            elif (too_large(query, words) if words and too_large is not None else callback(query)) is False:
                refuse(query, BUSY)

        queryable = self._session.declare_queryable(expression, take, complete=True)
        self._kept.append(queryable)
        return queryable

    def token(self, key: str) -> zenoh.LivelinessToken:
        """Declare a liveliness token; it lasts until it is undeclared or the session ends."""
        token = self._session.liveliness().declare_token(key)
        self._kept.append(token)
        return token

    def tokens(self, expression: str, timeout_s: float = 5.0) -> list[str]:
        """The tokens alive now; none as well if nothing answers in time."""
        # While a watch is told what is there already, Zenoh answers a get for the same tokens with some or none.
        with self._lock:
            if expression in self._alive:
                return sorted(self._alive[expression])
        replies = self._session.liveliness().get(expression, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def watch_tokens(self, expression: str, callback: Callable[[str, bool], object]) -> None:
        """Call back with (key, alive) for every token there is and every change, on a Zenoh thread, until closed."""
        awaited = set(self.tokens(expression))
        alive: set[str] = set()
        told = threading.Event()

        def tell(sample: zenoh.Sample) -> None:
            key, came = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            with self._lock:
                (alive.add if came else alive.discard)(key)
                awaited.discard(key)
            callback(key, came)
            if not awaited:
                told.set()

        subscriber = self._session.liveliness().declare_subscriber(
            expression,
            tell,
            history=True,
        )
        self._kept.append(subscriber)
        if awaited:
            told.wait(_HISTORY_S)
        with self._lock:
            self._alive[expression] = alive

    def query(
        self,
        selector: str,
        *,
        payload: bytes | None = None,
        encoding: str | None = None,
        timeout_s: float = 1.0,
        qos: Qos = Qos.COMMAND,
    ) -> Iterator[Sample | Failure]:
        """Ask everyone (target all, no consolidation), yield the answers as they come; a time-out yields a Failure."""
        replies = self._session.get(
            selector,
            zenoh.handlers.FifoChannel(_ANSWERS),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=payload,
            encoding=encoding,
            **ZENOH_QOS[qos],
        )
        for reply in replies:
            if reply.ok is not None:
                yield sample_of(reply.ok)
            elif reply.err is not None:
                yield Failure(reply.err.payload.to_string())

    def recall(self, expression: str, last_s: float, *, timeout_s: float = 5.0) -> Iterator[zenoh.Sample]:
        """Publications of the last seconds that their publishers still hold, those that were received, too.

        They are those of `Publisher` that are alive now, with the time and the number under which each was published;
        those of one publisher come in order. Blocks until all have answered.
        """
        replies = self._session.get(
            f"{expression}/@adv/pub/**?_time=[now(-{last_s:.3f}s)..]",  # where zenoh.ext's publishers answer
            zenoh.handlers.FifoChannel(_ANSWERS),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=timeout_s,
        )
        return (reply.ok for reply in replies if reply.ok is not None)

    @property
    def hubs(self) -> tuple[str, ...]:
        """The ids of the routers that there is a link to now; a hub that was started again has another."""
        return tuple(sorted(str(hub) for hub in self._session.info.routers_zid()))

    def put_command(self, key: str, payload: bytes, encoding: str, sequence: int = 1) -> None:
        """Publish one command of a stream (drive); `sequence` counts within it, from 1."""
        self.put_again(key, payload, encoding, sequence, Qos.COMMAND)

    def put_again(self, key: str, payload: bytes, encoding: str, sequence: int, qos: Qos) -> None:
        """Publish a payload as it is, under the number that it was given; 0: under none."""
        source = zenoh.SourceInfo(self._session.id, (sequence - 1) & 0xFFFFFFFF) if sequence else None
        self._session.put(key, payload, encoding=encoding, source_info=source, **ZENOH_QOS[qos])
