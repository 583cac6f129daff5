"""The only place that opens a Zenoh session, except the hub: publications, subscriptions, queries, liveliness tokens.

A queryable answers the queries for its keys. A liveliness token is a key that others can see while its session is
connected. A watch reports which tokens appear and disappear.
"""

import atexit
import itertools
import os
import sys
import threading
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from math import inf
from queue import SimpleQueue
from time import monotonic
from typing import Any, Final, Self

import zenoh

from schemas.bus.declared import Declare, Declared, SampleChannel
from schemas.bus.endpoint import (
    accepts,
    client_config,
    credentials_of,
    ensure_hub,
    is_loopback,
    is_secure,
    resolve_endpoint,
    unreachable,
)
from schemas.bus.errors import BusError, NoFleet
from schemas.bus.overlap import TWIN_S, Overlap, mark_of_query, mark_of_sample
from schemas.bus.publisher import ZENOH_QOS, Publisher
from schemas.bus.replies import BUSY, refuse
from schemas.bus.sample import Failure, Sample, sample_of, session_of, why_unread
from schemas.keys import renewal_key
from schemas.process import signals
from schemas.topics import Qos, Topic

# On a busy machine, existing tokens arrive late. A token that disappears meanwhile never arrives, so there is a limit.
_TOKEN_HISTORY_TIMEOUT_S: Final = 2.0
"""Timeout for the existing tokens at the start of a watch."""
LINK_TIMEOUT_S: Final = 2.0
"""Time for which a question for tokens waits for a lost link. After 0.2 to 0.5 s a session has its link again."""
_LINK_POLL_S: Final = 0.02
_PROMPT_S: Final = 1.0
"""Half the lease of a link: a link that is silent for the whole lease has ended. If an answer takes longer than this,
the link may have ended before the answer was complete."""
_END_OF_LINK_S: Final = 0.1
"""Time within which a session notices that its link has ended."""

_THREAD_END_TIMEOUT_S: Final = 2.0
"""Timeout for the end of a callback when the session is closed."""
_DECLARE_LOCK: Final = threading.Lock()

OVERLAP_S: Final = 0.5
"""Time for which both sessions are used when `reopen` replaces the first by the second. After it, the hubs of other
sites know the second one, too. Then the first one is kept for the same time again, for messages that are still on their
way."""
ANSWERS_S: Final = 12.0
"""Time for which the first session stays open for late answers. Except to a recorder, no query waits longer than
10 s."""
RECALL_TIMEOUT_S: Final = 5.0
"""Timeout for what publishers have cached. A publisher on a bad network takes seconds."""
REOPEN_TIMEOUT_S: Final = 5.0
TOKENS_OF_NOBODY: Final = "*/@hub"
"""A key for a query that is only a barrier. No such token exists, but everyone may ask for it: when the hub answers, it
has handled all earlier messages of the session."""

_NEWEST_EVENTS: Final = 16
"""Number of kept events of a link. A session has one link at a time, and only the newest event matters."""
_MAX_QUEUED_ANSWERS: Final = 1 << 16
"""Maximum number of queued answers of one query. If the queue is full, the link stalls, and Zenoh drops answers."""


class Bus:
    """One Zenoh session. Close it (`with`). The interpreter closes open ones when it exits, with a ResourceWarning."""

    def __init__(self, session: zenoh.Session, endpoint: str, identity: str = "") -> None:
        self._session = self._declaring = session
        self._link = SessionLink(session)
        self.identity = identity
        """Owner of this session's certificate, such as `person.mia`. Empty on a bus without certificates."""
        self._declarations: list[Declared] = []
        self._publishers: list[Publisher] = []
        self._next_declaration = itertools.count()
        self._number = 0
        """Number of the newest session: `reopen` opens the next one."""
        self._overlap: Overlap | None = None
        """Recognizes second copies while there are two sessions."""
        self._changing = threading.Lock()
        """Held while something is declared, and while everything is declared again in a new session."""
        self._lock = threading.Lock()
        self._threads: set[threading.Thread] = set()
        """Threads of Zenoh that run our callbacks."""
        self._alive: dict[str, set[str]] = {}
        """Existing tokens by watched expression."""
        self._token_news: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        """Calls of the callbacks of watches, in the order of the tokens. None ends the thread that makes them."""
        self._token_reporter: threading.Thread | None = None
        self._answered_over = ""
        """The link over which a question for tokens was answered before, so that the next answer over it is whole.
        Empty while tokens of a watch may still be on their way."""
        self.endpoint = endpoint
        self.boot_id = os.urandom(16).hex()
        self._pid = os.getpid()
        self._closing = threading.Event()
        self._keeper: threading.Thread | None = None
        atexit.register(self._close_at_exit)

    @classmethod
    def open(
        cls, endpoint: str | None = None, *, start_hub: bool = False, timeout_s: float = 5.0, identity: str = ""
    ) -> Self:
        """Open a session at the endpoint (see `resolve_endpoint`).

        With `start_hub`, start a hub if the endpoint is on this computer and there is none. Without it, raise NoFleet
        then. If the endpoint is on another computer and no hub answers there, raise HubUnreachable. Raises BadEndpoint,
        and BusError if what answers is no hub, or refuses this session.

        `identity` is the owner of the certificate to use, such as `car.red`; by default it is the user. It matters only
        to a hub with certificates. Raises NoCredentials if this computer has no such certificate.
        """
        where = resolve_endpoint(endpoint)
        if is_secure(where):
            identity = credentials_of(where).identity(identity)
            # For a hub with TLS, the probe of `accepts` is a failed handshake, after which the hub accepts no link for
            # 0.1 s. So first try to connect without that probe.
            with signals.held_back(), suppress(zenoh.ZError):
                return cls(zenoh.open(client_config(where, 0.0, identity)), where, identity)._with_keeper()
        else:
            identity = ""
        if start_hub:
            ensure_hub(where)
        elif not accepts(where):
            if not is_loopback(where):
                raise unreachable(where)
            raise NoFleet(
                "Nothing is running yet. Start your cars with `fleet up`, or simulated ones with `fleet up --sim 3`. "
                f"(Tried {where}; give another address with --connect.)",
                where,
            )
        with signals.held_back():
            try:
                session = zenoh.open(client_config(where, timeout_s, identity))
            except zenoh.ZError as error:
                if identity and (why := credentials_of(where).why_invalid(identity)):
                    raise BusError(why) from error
                may_be = f", or refuses the certificate of {identity}" if identity else ""
                raise BusError(
                    f"{where} does not answer, or is not a Zenoh router{may_be}. Give the fleet's address by --connect."
                ) from error
            return cls(session, where, identity)._with_keeper()

    def _with_keeper(self) -> Self:
        """Start to renew the certificate of this session, if it has one."""
        if self.identity:
            from schemas.bus.certificate_renewer import CertificateKeeper

            own, me = credentials_of(self.endpoint), self.identity
            keeper = CertificateKeeper(own, me, ask=self._ask_hub, reopen=self.reopen, closing=self._closing)
            self._keeper = keeper
            keeper.start()
        return self

    def _ask_hub(self, request: bytes, timeout_s: float) -> bytes:
        """Return the hub's answer to a request for the next certificate. Empty if it does not answer, or refuses."""
        key = renewal_key(self.identity)
        for answer in self.query(key, payload=request, timeout_s=timeout_s):
            if isinstance(answer, Sample):
                return answer.payload
        return b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_of_other_process(self) -> bool:
        """True in a process that was forked from the one with the session. Zenoh's threads are not in it."""
        return os.getpid() != self._pid

    def close(self) -> None:
        """Undeclare everything and close the session."""
        with signals.held_back():
            atexit.unregister(self._close_at_exit)
            self._closing.set()
            if self._keeper is not None and self._keeper is not threading.current_thread():
                self._keeper.join(REOPEN_TIMEOUT_S)
            self._declarations.clear()
            self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
            # A daemon thread that is still in Zenoh's code when the interpreter ends would abort the process.
            self._token_news.put(None)
            threads = self._threads if self._token_reporter is None else {*self._threads, self._token_reporter}
            for thread in threads - {threading.current_thread()}:
                thread.join(_THREAD_END_TIMEOUT_S)

    def _close_at_exit(self) -> None:
        if not self.is_of_other_process:
            words = f"the session at {self.endpoint} was not closed: use `with`, or call close()"
            warnings.warn(words, ResourceWarning, stacklevel=1)
            self.close()

    def _declare(self, declare: Declare) -> Declared:
        """Declare something with a callback, and remember it for `reopen`."""
        declared = Declared(declare)
        self._keep(declared, self._on_a_daemon)
        return declared

    @contextmanager
    def while_open(self) -> Iterator[None]:
        """Raise BusError instead of Zenoh's error if another thread closes the session during this block."""
        try:
            yield
        except zenoh.ZError as error:
            if not self._closing.is_set():
                raise
            raise BusError(f"the session at {self.endpoint} was closed meanwhile") from error

    def _keep(self, declared: Declared, declare: Callable[[Declared], None]) -> None:
        with self._changing, self.while_open():
            self._declarations = [each for each in self._declarations if not each.is_over]
            declare(declared)
            self._declarations.append(declared)

    def _on_this_thread(self, declared: Declared) -> None:
        declared.add(self._declaring, self._number)

    def _on_a_daemon(self, declared: Declared) -> None:
        # Zenoh starts a Python thread for each callback. When the interpreter exits, it joins all threads but daemons,
        # before any exit handler runs. Zenoh's thread is a daemon if the thread that declares is one.
        # A Future instead of the list would import logging, which is 4 ms of a gateway's start.
        errors: list[BaseException] = []

        def run() -> None:
            with _DECLARE_LOCK:
                before = _zenoh_threads()
                try:
                    self._on_this_thread(declared)
                except BaseException as error:  # noqa: BLE001 - raised again after the join
                    errors.append(error)
                self._threads |= _zenoh_threads() - before

        thread = threading.Thread(target=run, name="bus-declare", daemon=True)
        # After a Ctrl-C here, nobody would join the threads, and an exit would abort the process.
        with signals.held_back():
            thread.start()
            thread.join()
            if errors:
                raise errors[0]

    def _is_twin(self, number: int, mark: Callable[[], Hashable], within_s: float = inf) -> bool:
        """Return True if the other session handles this message, so that this copy must be dropped.

        `number` is the session over which this copy came. For `within_s`, see `Overlap.is_twin`.
        """
        overlap, is_newest = self._overlap, number == self._number
        if overlap is None:
            return not is_newest
        return overlap.is_twin(mark(), monotonic(), newer=is_newest, within_s=within_s)

    def reopen(self, overlap_s: float = OVERLAP_S, answers_s: float = ANSWERS_S) -> None:
        """Continue in a second session, with the certificate that is in the file now, and close the first session.

        No message is lost or handled twice, and tokens do not disappear. The call blocks for the overlap and for late
        answers; `close` ends that wait. If it raises BusError, the first session stays in use.
        """
        first = self._session
        try:
            second = zenoh.open(client_config(self.endpoint, REOPEN_TIMEOUT_S, self.identity))
        except zenoh.ZError as error:
            raise BusError(f"{self.endpoint} refuses a second session of {self.identity}: {error}") from error
        try:
            self._declare_again(second)
            # Declaring does not wait for the hub. But when it answers this query, it has passed on the declarations.
            for _ in second.liveliness().get(TOKENS_OF_NOBODY, timeout=REOPEN_TIMEOUT_S):
                pass
        except zenoh.ZError as error:
            self._undo(first)
            second.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
            raise BusError(f"the second session at {self.endpoint} failed: {error}") from error
        self._closing.wait(overlap_s)
        with self._changing:
            for publisher in self._publishers:
                publisher.move()
            self._session, self._link = second, SessionLink(second)
            assert self._overlap is not None
            self._overlap.older_is_deaf = True
        self._closing.wait(overlap_s)
        with self._changing:
            for declared in self._declarations:
                declared.keep_newest()
            self._overlap = None
        self._closing.wait(answers_s)
        first.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type

    def _declare_again(self, second: zenoh.Session) -> None:
        with self._changing:
            self._declaring = second
            self._number += 1
            self._overlap = Overlap()
            for declared in self._declarations:
                if not declared.is_over:
                    self._on_a_daemon(declared)
            for publisher in self._publishers:
                publisher.prepare(second)

    def _undo(self, first: zenoh.Session) -> None:
        with self._changing:
            self._declaring = first
            self._number -= 1
            self._overlap = None
            for declared in self._declarations:
                declared.keep_oldest()

    @property
    def id(self) -> str:
        """The session's Zenoh id."""
        return str(self._session.zid())

    @property
    def connected(self) -> bool:
        """True if there is a link to a router now."""
        return bool(self._session.info.routers_zid())

    def publisher(self, key: str, topic: Topic, source: str) -> Publisher:
        """Declare a publisher of `topic` under `key`. `source` is the `car` of its messages."""
        with self._changing, self.while_open():
            made = Publisher(self._declaring, key, topic, source, self.boot_id)
            self._publishers.append(made)
        return made

    def subscribe(
        self,
        expression: str,
        callback: Callable[[Sample], object],
        *,
        largest: int | None = None,
        admits: Callable[[str, str], bool] | None = None,
    ) -> Declared:
        """Subscribe. The callback runs on a Zenoh thread, so it must hand the sample over and return.

        `largest` is the maximum size of a payload in bytes (see `Sample.why_unread`). `admits` is called with the key
        of each message and the session that published it, before anything else is read (see `session_of`). If it
        returns False, the message is dropped.
        """
        declaration = next(self._next_declaration)

        def declare(session: zenoh.Session, number: int) -> Any:
            def on_sample(sample: zenoh.Sample) -> None:
                if admits is not None and not admits(str(sample.key_expr), session_of(sample)):
                    return
                if not self._is_twin(number, lambda: mark_of_sample(declaration, sample)):
                    callback(sample_of(sample, largest))

            return session.declare_subscriber(expression, on_sample)

        return self._declare(declare)

    def subscribe_channel(self, expression: str, capacity: int) -> SampleChannel:
        """Subscribe with a channel for `try_recv`. Read it often: a full channel stalls the whole session."""
        # A channel costs half as much per message as a callback. The recorder needs that, because it reads everything.
        channel = SampleChannel(
            lambda session, _: session.declare_subscriber(expression, zenoh.handlers.FifoChannel(capacity)),
            next(self._next_declaration),
        )
        self._keep(channel, self._on_this_thread)
        return channel

    def queryable(
        self,
        expression: str,
        callback: Callable[[zenoh.Query], object],
        *,
        too_large: Callable[[zenoh.Query, str], object] | None = None,
    ) -> Declared:
        """Declare a queryable. The callback runs on a Zenoh thread, so it must hand the query over and return.

        If the callback returns False, the query is answered with BUSY. A query with a part that is too large is passed
        to `too_large` with the reason; without `too_large` it is refused.
        """
        declaration = next(self._next_declaration)

        def declare(session: zenoh.Session, number: int) -> Any:
            def on_query(query: zenoh.Query) -> None:
                words = why_unread(query)
                if self._is_twin(number, lambda: mark_of_query(declaration, query), TWIN_S):
                    with query:  # leave it unanswered, because its other copy gets an answer
                        return
                if not words:
                    taken = callback(query)
                elif too_large is not None:
                    taken = too_large(query, words)
                else:
                    refuse(query, words)
                    return
                if taken is False:
                    refuse(query, BUSY)

            return session.declare_queryable(expression, on_query, complete=True)

        return self._declare(declare)

    def token(self, key: str) -> Declared:
        """Declare a liveliness token. It lasts until it is undeclared or the bus is closed."""
        token = Declared(lambda session, _: session.liveliness().declare_token(key))
        self._keep(token, self._on_this_thread)
        return token

    def tokens(self, expression: str, timeout_s: float = 5.0) -> list[str]:
        """Return the existing tokens. After a timeout, return those that have come by then.

        A link that was lost is awaited for up to 2 s, unless the session watches this expression.
        """
        # Zenoh answers a session without a link at once, as if there were no tokens. And right after a watch was
        # declared or a new link was opened, an answer lacks the tokens that are still on their way to that watch. So a
        # session with watches asks twice over each new link: the second answer comes behind those tokens.
        wanted, end = zenoh.KeyExpr(expression), monotonic() + timeout_s
        link_end = min(end, monotonic() + LINK_TIMEOUT_S)
        while True:
            asked_at, link, answered_over = monotonic(), self._link.address, self._answered_over
            with self._lock:
                if expression in self._alive and link in ("", answered_over):
                    return sorted(self._alive[expression])
            if not link and monotonic() < link_end and not self._closing.is_set():
                self._closing.wait(_LINK_POLL_S)
                continue
            with self.while_open():
                replies = self._session.liveliness().get(expression, timeout=max(end - asked_at, _LINK_POLL_S))
            found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
            with self._lock:
                is_watching = bool(self._alive)
                watched = {key for each in self._alive.values() for key in each}
            found |= {key for key in watched if wanted.intersects(zenoh.KeyExpr(key))}
            self._answered_over = link
            now = monotonic()
            is_prompt = now - asked_at < _PROMPT_S
            is_whole = is_prompt and link == self._link.address and (link == answered_over or not is_watching)
            if is_whole or now >= (end if link else link_end):
                return sorted(found)
            if not is_prompt:
                self._closing.wait(_END_OF_LINK_S)

    def watch_tokens(self, expression: str, callback: Callable[[str, bool], object]) -> None:
        """Call back with (key, alive) for every existing token and every change, on a thread of this bus."""
        awaited = set(self.tokens(expression))
        alive: set[str] = set()
        complete = threading.Event()

        def declare(session: zenoh.Session, number: int) -> Any:
            def on_token(sample: zenoh.Sample) -> None:
                key, came = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
                with self._lock:
                    if number != self._number and self._overlap is None:
                        return
                    is_twin = self._overlap is not None and (key in alive) is came  # the other session has reported it
                    if came:
                        alive.add(key)
                    else:
                        alive.discard(key)
                    awaited.discard(key)
                    if not is_twin:
                        self._token_news.put(partial(callback, key, came))
                    if not awaited:
                        self._token_news.put(complete.set)

            # Zenoh's own thread for a callback may be late on a busy machine: then an answer over a new link came
            # earlier than the tokens before it. Called at once, `on_token` has run when a later answer arrives.
            at_once = zenoh.handlers.Callback(on_token, indirect=False)
            return session.liveliness().declare_subscriber(expression, at_once, history=True)

        self._start_to_report_tokens()
        self._declare(declare)
        # The thread that calls back cannot wait for itself: a callback that declares a watch gets its calls afterwards.
        is_callback = threading.current_thread() is self._token_reporter
        if awaited and (is_callback or not complete.wait(_TOKEN_HISTORY_TIMEOUT_S)):
            self._answered_over = ""
        with self._lock:
            self._alive[expression] = alive

    def _start_to_report_tokens(self) -> None:
        """Start the thread that calls back for all watches, unless it runs."""
        with self._lock:
            if self._token_reporter is None:
                self._token_reporter = threading.Thread(target=self._report_tokens, name="bus-tokens", daemon=True)
                self._token_reporter.start()

    def _report_tokens(self) -> None:
        while (report := self._token_news.get()) is not None:
            try:
                report()
            except Exception:  # noqa: BLE001 - one callback's error must not end the others
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._token_reporter)))

    def query(
        self,
        selector: str,
        *,
        payload: bytes | None = None,
        encoding: str | None = None,
        timeout_s: float = 1.0,
        qos: Qos = Qos.COMMAND,
    ) -> Iterator[Sample | Failure]:
        """Send a query to everyone, and yield the answers as they arrive. A timeout yields a Failure."""
        with self.while_open():
            replies = self._session.get(
                selector,
                zenoh.handlers.FifoChannel(_MAX_QUEUED_ANSWERS),
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

    def recall(self, expression: str, last_s: float, *, timeout_s: float = RECALL_TIMEOUT_S) -> Iterator[zenoh.Sample]:
        """Return publications of the last seconds from the caches of running publishers (`Publisher`).

        These publications have their original time and sequence number. Those of one publisher are in order. Reading
        blocks until all publishers have answered.
        """
        replies = self._session.get(
            f"{expression}/@adv/pub/**?_time=[now(-{last_s:.3f}s)..]",  # where zenoh.ext's publishers answer
            zenoh.handlers.FifoChannel(_MAX_QUEUED_ANSWERS),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=timeout_s,
        )
        return (reply.ok for reply in replies if reply.ok is not None)

    @property
    def link(self) -> str:
        """The link to the hub: a text that no two links share. Empty while messages reach no hub."""
        return self._link.address

    def put_command(self, key: str, payload: bytes, encoding: str, sequence: int = 1) -> None:
        """Publish one command of a stream (drive). `sequence` is its number within the stream, from 1."""
        self.put_again(key, payload, encoding, sequence, Qos.COMMAND)

    def put_again(self, key: str, payload: bytes, encoding: str, sequence: int, qos: Qos) -> None:
        """Publish an encoded payload as it is, with this sequence number, or without one if it is 0."""
        source = zenoh.SourceInfo(self._session.id, (sequence - 1) & 0xFFFFFFFF) if sequence else None
        self._session.put(key, payload, encoding=encoding, source_info=source, **ZENOH_QOS[qos])


class SessionLink:
    """Follows the link of one session to its hub, from the moment in which it carries messages.

    Zenoh lists a new link a moment before messages take it. Until then it answers each question for tokens at once, as
    if there were none. The event of the link comes after that moment.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        # A ring never makes Zenoh wait, however seldom it is read.
        events = session.info.declare_link_events_listener(zenoh.handlers.RingChannel(_NEWEST_EVENTS), history=True)
        self._next_event = events.handler.try_recv
        self._events = events  # the listener ends with this object
        self._reading = threading.Lock()
        self._opened = ""

    @property
    def address(self) -> str:
        """Address of our end, which no two links share. Empty while messages reach no hub, and of a closed session."""
        with self._reading:
            try:
                while (event := self._next_event()) is not None:
                    if event.kind == zenoh.SampleKind.PUT:
                        self._opened = str(event.link.src)
                    elif self._opened == str(event.link.src):
                        self._opened = ""
                is_listed = any(str(link.src) == self._opened for link in self._session.info.links())
            except zenoh.ZError:  # the session is closed, perhaps by another thread just now
                return ""
            return self._opened if is_listed else ""


def _zenoh_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.endswith("(pyo3-closure)")}
