"""The only place that opens a Zenoh session: publications, subscriptions, queries, tokens, and the way to the hub.

A Zenoh callback runs on a foreign thread and does one thing: hand over (`Handover`) to the asyncio loop that owns
the state.
"""

import contextlib
import json
import os
import re
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

import zenoh
from zenoh import ext

from schemas.keys import BadKey
from schemas.topics import Qos, Topic

if TYPE_CHECKING:  # a gateway is on the bus before it has imported these
    import asyncio

    from google.protobuf.message import Message

T = TypeVar("T")

_TURN: Final = 16
"""Objects that are handed over in one iteration of a loop."""

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
ENDPOINT_VARIABLE: Final = "FLEET_ENDPOINT"

_ENDPOINT: Final = re.compile(r"(?P<proto>tcp|tls|udp|quic|ws)/(?P<host>\[[^\]]+\]|[^:/\[\]]+):(?P<port>\d{1,5})")
_LOOPBACK: Final = re.compile(r"localhost|127\.\d+\.\d+\.\d+|\[::1\]")
_HISTORY_S: Final = 2.0
"""The longest that a watch waits for what is there already: for a token that goes in this very moment.

On a busy machine what is there may take a while to be told, and who asks meanwhile would be told that there is less."""

_QOS: Final[dict[Qos, dict[str, Any]]] = {
    Qos.READING: {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA},
    Qos.STATE: {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA_HIGH},
    Qos.COMMAND: {
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
}


LARGEST_PAYLOAD: Final = 1 << 16
"""Bytes of a query's payload, or of a streamed command's: what is larger is refused, and its payload is not read.

Reading 5 MB of JSON stalls a process for a second."""
LONGEST_SELECTOR: Final = 4096
"""Characters of a query's selector (key and parameters), and of its encoding."""
BUSY: Final = "busy: too many questions wait here already; ask again later"
_ANSWERS: Final = 1 << 16
"""Answers that wait for who asked: beyond them the link stands still, and what comes is dropped on the way."""


class BusError(Exception):
    """The bus cannot be had; its text names the endpoint and what to do."""


class NoFleet(BusError):
    """Nothing listens at the endpoint."""


class BadEndpoint(BusError):
    """An endpoint that Zenoh cannot take, or at which no hub may listen."""


def resolve_endpoint(argument: str | None = None) -> str:
    """The endpoint to use: the argument, else FLEET_ENDPOINT, else loopback port 7447; raises BadEndpoint."""
    endpoint = argument or os.environ.get(ENDPOINT_VARIABLE) or DEFAULT_ENDPOINT
    _host_and_port(endpoint)
    return endpoint


def _host_and_port(endpoint: str) -> tuple[str, int]:
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise BadEndpoint(
            f"endpoint {endpoint!r} is not allowed: write it as tcp/HOST:PORT (tls, udp, quic or ws also), "
            f"port 1 to 65535, for example {DEFAULT_ENDPOINT}"
        )
    return match["host"], int(match["port"])


def is_loopback(endpoint: str) -> bool:
    """Return True if no other machine can reach the endpoint; raises BadEndpoint."""
    host, _ = _host_and_port(endpoint)
    return _LOOPBACK.fullmatch(host) is not None


def check_listening(endpoint: str, *, insecure_lan: bool) -> None:
    """Raise BadEndpoint if a hub would be open to a network without a word from the user.

    A hub knows no passwords and no certificates: whoever reaches it drives the cars.
    """
    if not insecure_lan and not is_loopback(endpoint):
        raise BadEndpoint(
            f"a hub at {endpoint} would let everyone on that network drive the cars: "
            f"use {DEFAULT_ENDPOINT}, start a Zenoh router of your own there, or accept it with --insecure-lan"
        )


_COMMON: Final[dict[str, Any]] = {
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
    "timestamping": {"enabled": True},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": 2000}}},
}


def router_config(endpoint: str) -> zenoh.Config:
    """The hub's configuration: it listens, everyone else is its client."""
    _host_and_port(endpoint)
    listen = {"endpoints": [endpoint], "exit_on_failure": True, "timeout_ms": 0}
    return zenoh.Config.from_json5(json.dumps({"mode": "router", "listen": listen, **_COMMON}))


def _client_config(endpoint: str, timeout_s: float) -> zenoh.Config:
    connect = {
        "endpoints": [endpoint],
        "timeout_ms": int(timeout_s * 1000),
        "exit_on_failure": True,
        "retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2},
    }
    return zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": connect, **_COMMON}))


def accepts(endpoint: str, timeout_s: float = 1.0) -> bool:
    """Whether something accepts connections at the endpoint; a datagram endpoint cannot be asked and counts as yes."""
    host, port = _host_and_port(endpoint)
    if endpoint.startswith(("udp/", "quic/")):
        return True
    try:
        with socket.create_connection((host.strip("[]"), port), timeout=timeout_s):
            return True
    except OSError:
        return False


def ensure_hub(endpoint: str, timeout_s: float = 30.0) -> None:
    """Start a hub if nothing accepts at a loopback endpoint, and wait until it does; raises BusError.

    The hub outlives its starter: it is a session leader of its own, so that Ctrl-C at a terminal does not take the bus
    away before the cars are stopped. It ends by itself 10 s after its last link. A busy computer may take ten seconds
    to start it.
    """
    if accepts(endpoint):
        return
    if not is_loopback(endpoint):
        raise NoFleet(
            f"nothing listens at {endpoint}, and a hub is started on loopback only: start a Zenoh router there "
            "(or fleet up --insecure-lan), or name another endpoint with --connect"
        )
    import subprocess

    command = [sys.executable, "-m", "schemas.hub", "--endpoint", endpoint]
    hub = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + timeout_s
    while not accepts(endpoint):
        if time.monotonic() > deadline:
            raise BusError(f"no hub came up at {endpoint} within {timeout_s:g} s: is the port used by something else?")
        # A hub that lost the race for the port has ended; the winner accepts in a moment.
        with contextlib.suppress(subprocess.TimeoutExpired):
            hub.wait(0.02)
            time.sleep(0.02)
    # The hub is nobody's child to wait for; without this the interpreter warns that it still runs.
    hub.returncode = 0 if hub.returncode is None else hub.returncode


def canon(expression: str) -> str:
    """A key expression as Zenoh writes it; raises BadKey for one that Zenoh does not take."""
    try:
        return str(zenoh.KeyExpr.autocanonize(expression))
    except zenoh.ZError as error:
        words = str(error).partition(" at /")[0]  # what follows is a place in Zenoh's source
        raise BadKey(f"key expression {expression!r} is not allowed: {words}") from None


def intersects(one: str, other: str) -> bool:
    """Whether some key matches both expressions; each must be as `canon` gives it."""
    return bool(zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other)))


class Handover(Generic[T]):
    """Hands objects from Zenoh's threads to one asyncio loop, in order and bounded; what does not fit is counted.

    Left out is what comes while it is full or, with `newest`, what has waited longest. It may be made before there is
    a loop: what comes waits until `attach`. In one iteration of the loop it hands over few, so that others get a turn.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop | None" = None,
        take: Callable[[T], object] | None = None,
        *,
        limit: int = 1024,
        newest: bool = False,
    ) -> None:
        self._loop = loop
        self._take = take
        self._limit = limit
        self._newest = newest
        self._lock = threading.Lock()
        self._waiting: deque[T] = deque()
        self.dropped = 0

    def attach(self, loop: "asyncio.AbstractEventLoop", take: Callable[[T], object]) -> None:
        """Say who takes what comes; on the loop's thread."""
        with self._lock:
            self._loop = loop
            self._take = take
        loop.call_soon(self._drain)

    def __call__(self, item: T, *, reserve: int = 0) -> bool:
        """Called on a Zenoh thread; False if the item was left out. `reserve`: how far it may go beyond the limit."""
        with self._lock:
            if len(self._waiting) >= self._limit + reserve:
                self.dropped += 1
                if not self._newest:
                    return False
                self._waiting.popleft()
            self._waiting.append(item)
            loop = self._loop
            if loop is None or len(self._waiting) > 1:
                return True
        try:
            loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop is closed: nobody is left to take it
            return False
        return True

    def _drain(self) -> None:
        assert self._loop is not None
        assert self._take is not None
        with self._lock:
            batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), _TURN))]
            left = bool(self._waiting)
        for item in batch:
            # One callback each: an item that raises takes no other with it.
            self._loop.call_soon(self._take, item)
        if left:
            self._loop.call_soon(self._drain)


class Backlog(Generic[T]):
    """Objects from Zenoh's threads that wait for one task of an asyncio loop, in order and bounded.

    The task takes one when it is done with the last: what takes long is done one at a time. It may be made before there
    is a loop.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._waiting: deque[T] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._came: asyncio.Event | None = None
        self.dropped = 0
        """How many found it full."""

    def attach(self, loop: "asyncio.AbstractEventLoop", came: "asyncio.Event") -> None:
        """Say whose task takes them; `came` is set when there are some. On the loop's thread."""
        with self._lock:
            self._loop, self._came = loop, came
        came.set()

    def __call__(self, item: T) -> bool:
        """Called on a Zenoh thread; False if the item was left out."""
        with self._lock:
            if len(self._waiting) >= self._limit:
                self.dropped += 1
                return False
            self._waiting.append(item)
            loop, came = self._loop, self._came
            if loop is None or came is None or len(self._waiting) > 1:
                return True
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to take it
            loop.call_soon_threadsafe(came.set)
        return True

    async def next(self) -> T:
        """The one that has waited longest; only one task may wait for it."""
        assert self._came is not None
        while True:
            with self._lock:
                if self._waiting:
                    return self._waiting.popleft()
                self._came.clear()
            await self._came.wait()


class Latest(Generic[T]):
    """Hands the latest value of each name from Zenoh's threads to one asyncio loop: changes of one name are merged.

    The first is handed over at once, what comes within `APART_S` after it together. Of more names than `limit` in that
    time the rest is left out, and counted.
    """

    APART_S: Final = 0.05

    def __init__(self, limit: int = 16_384) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._changed: dict[str, T] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._take: Callable[[dict[str, T]], object] | None = None
        self._told_at = float("-inf")
        self.dropped = 0

    def attach(self, loop: "asyncio.AbstractEventLoop", take: "Callable[[dict[str, T]], object]") -> None:
        """Say who takes what has changed, the latest of each name; on the loop's thread."""
        with self._lock:
            self._loop, self._take = loop, take
        loop.call_soon(self._tell)

    def __call__(self, name: str, value: T) -> bool:
        """Called on a Zenoh thread; False if the change was left out."""
        with self._lock:
            first = not self._changed
            if len(self._changed) >= self._limit and name not in self._changed:
                self.dropped += 1
                return False
            self._changed.pop(name, None)  # in the order of the last changes
            self._changed[name] = value
            loop = self._loop
        if first and loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to take it
                loop.call_soon_threadsafe(self._schedule)
        return True

    def taken(self) -> dict[str, T]:
        """What has changed since it was taken last, for who comes by itself."""
        with self._lock:
            changed, self._changed = self._changed, {}
        return changed

    def _schedule(self) -> None:
        assert self._loop is not None
        self._loop.call_at(self._told_at + self.APART_S, self._tell)

    def _tell(self) -> None:
        assert self._loop is not None
        assert self._take is not None
        self._told_at = self._loop.time()
        if changed := self.taken():
            self._take(changed)


@dataclass(frozen=True, slots=True)
class Sample:
    """One publication or reply as it came: payload bytes untouched."""

    key: str
    payload: bytes
    encoding: str
    time_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch; the time of receipt where there is none."""
    sequence: int
    """The publisher's number for the key, modulo 2^32; 0 if it gave none."""
    deleted: bool = False
    unread: str = ""
    """Why the payload was not read, and is left out: it is too large."""

    def message(self) -> "Message":
        """The payload as the message that the encoding names; raises messages.BadPayload or KeyError."""
        from schemas import messages

        name = messages.name_in(self.encoding)
        if name is None:
            raise messages.BadPayload(f"{self.key}: encoding {self.encoding!r} names no message")
        return messages.parse(name, self.payload, self.encoding)


@dataclass(frozen=True, slots=True)
class Failure:
    """An error reply."""

    words: str


def sequence_of(info: zenoh.SourceInfo) -> int:
    """A publisher's number for a key, from 1, modulo 2^32: Zenoh counts from 0."""
    return (int(info.source_sn) + 1) & 0xFFFFFFFF


def sample_of(sample: zenoh.Sample, largest: int | None = None) -> Sample:
    """Copy what is wanted out of a Zenoh sample; `largest`: bytes of a payload that is read."""
    stamp = sample.timestamp
    info = sample.source_info
    unread = "" if largest is None else _too_many_bytes(len(sample.payload), largest)
    return Sample(
        key=str(sample.key_expr),
        payload=b"" if unread else sample.payload.to_bytes(),
        encoding=str(sample.encoding),
        time_ns=stamp.get_time_as_ntp64().as_nanos() if stamp is not None else time.time_ns(),
        sequence=sequence_of(info) if info is not None else 0,
        deleted=sample.kind == zenoh.SampleKind.DELETE,
        unread=unread,
    )


def _too_many_bytes(size: int, largest: int) -> str:
    if size <= largest:
        return ""
    return f"a payload of {size} bytes is too large: at most {largest} are read, so nothing of it was"


def unread(query: zenoh.Query) -> str:
    """Why nothing of a query is read: something in it is too large. Empty if nothing is."""
    payload = query.payload
    if payload is not None and (words := _too_many_bytes(len(payload), LARGEST_PAYLOAD)):
        return words
    longest = max(len(str(query.selector)), len(str(query.encoding)) if query.encoding is not None else 0)
    if longest > LONGEST_SELECTOR:
        return f"a key, parameters or an encoding of {longest} characters: at most {LONGEST_SELECTOR} are read"
    return ""


def refuse(query: zenoh.Query, words: str) -> None:
    """Answer a query with an error, and end it."""
    with query:
        query.reply_err(words, encoding="text/plain")


class Publisher:
    """Publishes one topic of one car; numbers the messages and fills their common fields.

    It holds the last of them (`Topic.held`), also those published while there was no hub: see `Bus.recall`.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, source: str, boot_id: str) -> None:
        self._publisher = ext.declare_advanced_publisher(
            session,
            key,
            encoding=zenoh.Encoding(topic.encoding),
            cache=ext.CacheConfig(topic.held),
            # Numbers only. Heartbeats and a token for each would double what a hub of a hundred cars has to do.
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            **_QOS[topic.qos],
        )
        self._source = source
        self._boot_id = boot_id
        self._headed = topic.message.startswith("fleet.v1.")
        self.key = key
        self.topic = topic
        self.sequence = 0

    def put(self, message: Any, stamp_ns: int) -> bytes:
        """Publish, return the payload; `stamp_ns`: ns since the epoch, when bytes were had or a decision was made."""
        self.sequence += 1
        if self._headed:
            message.stamp.seconds, message.stamp.nanos = divmod(stamp_ns, 1_000_000_000)
            message.car = self._source
            message.seq = self.sequence
            message.boot_id = self._boot_id
        payload: bytes = message.SerializeToString()
        self._publisher.put(payload)
        return payload


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
            session = zenoh.open(_client_config(where, timeout_s))
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
            **_QOS[qos],
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
        self._session.put(key, payload, encoding=encoding, source_info=source, **_QOS[qos])


def reply(query: zenoh.Query, key: str, payload: bytes, encoding: str, *, express: bool = True) -> None:
    """Answer a query with one value under a concrete key; `express`: at once, not batched with others."""
    query.reply(key, payload, encoding=encoding, express=express)


def reply_value(query: zenoh.Query, key: str, payload: bytes, topic: Topic, *, express: bool = True) -> None:
    """Answer a query with a value of a topic, as protobuf or as JSON as it asks (`?format=json`).

    Of many values each must not be express: each would be a batch of its own, and what finds no room is dropped.
    """
    if query.parameters.get("format") == "json":
        from schemas import messages

        text = messages.to_json(messages.parse(topic.message, payload, topic.encoding))
        reply(query, key, text.encode(), messages.JSON, express=express)
    else:
        reply(query, key, payload, topic.encoding, express=express)
