"""Asks the caches of publishers for messages that a recorder missed. session_writer.py drops duplicates.

A recording has holes exactly where they matter most: the moment when the network broke is the moment that somebody will
want to look at. A subscriber alone cannot prevent that, because messages that were published while it was away are
gone. So each publisher caches its last publications: ten seconds at the rate of its topic, but at least a hundred
(`Topic.cache_size`). For a state this is up to 100 s, for an event perhaps hours. backfill_plan.py decides who is
asked, and when.

Messages that cannot be fetched are not hidden: the writer counts them, the status shows the count, and `sessions
verify` lists the gaps.
"""

import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from itertools import repeat
from math import inf
from typing import Final

import zenoh

from fleet.recording.writing.backfill_plan import EVERYTHING, BackfillPlan, PlannedQuery
from schemas.bus import Bus
from schemas.bus.sample import session_of
from schemas.bus.zenoh_session import RECALL_TIMEOUT_S

BACKFILL_POLL_INTERVAL_S: Final = 0.2
LEASE_POLLS: Final = round(2.0 / BACKFILL_POLL_INTERVAL_S)
"""Number of polls in 2 s. This is Zenoh's lease: only a silence of this time shows that a link is lost, so messages may
be missing since its beginning. Counted in polls, so that a stall of this process makes the window longer."""
MIN_QUERY_TIMEOUT_S: Final = 0.1
"""Minimum timeout of the last query that begins in time."""
MAX_CLOSE_S: Final = 15.0
"""Maximum time for the last queries. `fleet up` waits 30 s for a recorder that ends."""
LAST_ROUNDS: Final = 2
"""Maximum number of last queries to one source. On a network that loses messages all the time, each is followed by new
gaps."""
MAX_ANSWERS: Final = 200_000
"""Maximum number of answers in the queue to the writer. The rest stays a gap, and is requested again."""


class Backfill:
    """Requests missed messages on its own thread, from `start` to `close`."""

    def __init__(self, bus: Bus, expressions: Sequence[str], *, resumes_s: float | None = None) -> None:
        """Prepare. `resumes_s`: how far back to ask first, if this recording continues an interrupted session."""
        self._bus = bus
        self._all = tuple(filter(_has_cache, expressions))
        self._lock = threading.Lock()
        self._gaps: dict[str, float] = {}
        """Keys with the time from which messages are missing, s, monotonic."""
        self._newcomers: dict[str, str] = {}
        """Keys with the source to ask."""
        self._answers: list[tuple[zenoh.Sample, bool]] = []
        self._closing = threading.Event()
        self._until = inf
        """When the thread ends at the latest."""
        self._thread = threading.Thread(target=self._run, name="recall")
        now = time.monotonic()
        self._plan = BackfillPlan(now, resume_since=None if resumes_s is None else now - resumes_s)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ask one last time for the messages that are still missing, and wait for the end of the thread."""
        self.end(MAX_CLOSE_S)
        self._thread.join()

    def end(self, within_s: float) -> None:
        """Let the thread ask one last time, and end within this time. A query that is under way may take longer."""
        self._until = min(time.monotonic() + within_s, self._until)
        self._closing.set()

    @property
    def is_running(self) -> bool:
        """True until the last query is answered."""
        return self._thread.is_alive()

    def request(self, keys: Mapping[str, float]) -> None:
        """Request a backfill of these keys. Each value is the age, in s, of the last message before the gap.

        The gap may be long: while a car is cut off, its gateway keeps publishing, and others hear it only afterwards.
        """
        now = time.monotonic()
        with self._lock:
            for key, age_s in keys.items():
                if _has_cache(key):
                    self._gaps[key] = min(now - age_s, self._gaps.get(key, now))

    def request_newcomers(self, sources: Mapping[str, str]) -> None:
        """Request all that the senders of these keys have published during the recording, before they were heard.

        Each value is the source to ask: a car, or only the key.
        """
        with self._lock:
            self._newcomers.update((key, source) for key, source in sources.items() if _has_cache(key))

    def take_answers(self) -> list[tuple[zenoh.Sample, bool]]:
        """Return the answers since the last call. Some may be recorded already.

        Each comes with True if its sender was asked for everything since the begin of the recording.
        """
        with self._lock:
            found, self._answers = self._answers, []
        return found

    def _run(self) -> None:
        link = self._bus.link
        polls = deque([time.monotonic()], LEASE_POLLS)
        connected_since = waiting_since = polls[0]
        while not self._closing.wait(BACKFILL_POLL_INTERVAL_S):
            now, connected = time.monotonic(), self._bus.link
            self._plan_missing(polls[0], now)
            # A process that was stopped for longer than a lease has lost its link, even if it has the same one again.
            was_stopped = now - waiting_since > LEASE_POLLS * BACKFILL_POLL_INTERVAL_S
            if connected and (connected != link or was_stopped):
                self._plan.add_reconnect(connected_since, now)
            link = connected
            if connected:
                connected_since = polls[0]
                self._ask(self._plan.due_queries(now))
            polls.append(now)
            waiting_since = time.monotonic()
        for _ in range(LAST_ROUNDS):
            self._plan_missing(polls[0], time.monotonic())
            self._ask(self._plan.last_queries(), is_last=True)
            if not self._gaps and not self._newcomers:  # none was noticed meanwhile
                break

    def _plan_missing(self, silent_since: float, now: float) -> None:
        with self._lock:
            gaps, self._gaps = self._gaps, {}
            newcomers, self._newcomers = self._newcomers, {}
        self._plan.add_gaps(gaps, silent_since, now)
        self._plan.add_newcomers(newcomers, now)

    def _ask(self, queries: Iterable[PlannedQuery], *, is_last: bool = False) -> None:
        """Send these queries. If the recording ends, leave the rest to the last ones, and those when time is up."""
        for query in queries:
            answered: set[str] = set()
            is_whole = True
            for expression in self._all if query.source == EVERYTHING else (f"{query.source}/**",):
                if time.monotonic() >= self._until or (self._closing.is_set() and not is_last):
                    return
                is_whole &= self._recall(expression, query, answered, is_last=is_last)
            if is_whole:
                self._plan.add_answers(query, answered)

    def _recall(self, expression: str, query: PlannedQuery, answered: set[str], *, is_last: bool) -> bool:
        """Fetch the messages, and add their keys to `answered`. Return False if this was cut short."""
        found: list[zenoh.Sample] = []
        is_whole, own = True, self._bus.id
        # Compute the window anew for each expression: on a bad network, the answers for one take seconds, and the
        # window of the next one would be too short.
        now = time.monotonic()
        timeout_s = min(RECALL_TIMEOUT_S, max(self._until - now, MIN_QUERY_TIMEOUT_S))
        for sample in self._bus.recall(expression, now - query.since, timeout_s=timeout_s):
            found.append(sample)
            has_room = len(found) + len(self._answers) <= MAX_ANSWERS
            if not has_room or (self._closing.is_set() and not is_last):  # the last queries ask for the rest
                is_whole = False
                break
        with self._lock:
            self._answers += zip(found, repeat(self._plan.asks_for_all(query)))
        # A recorder publishes, too. Its own answer says nothing about the recorder of another site.
        answered.update(str(each.key_expr) for each in found if session_of(each) != own)
        return is_whole


def _has_cache(key: str) -> bool:
    """Return False for a command stream: the clients that send it have no cache."""
    return "@cmd" not in key
