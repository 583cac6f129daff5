"""Asks the caches of publishers for messages that a recorder missed. session_writer.py drops duplicates.

A recording has holes exactly where they matter most: the moment when the network broke is the moment that somebody will
want to look at. A subscriber alone cannot prevent that, because messages that were published while it was away are
gone. So each publisher caches its last publications: ten seconds at the rate of its topic, but at least a hundred
(`Topic.cache_size`). For a state this is minutes, for an event hours.

When should the recorder ask? After its own link to the hub is back. After a gap in the numbers of a publisher, which
shows that the *car* was cut off. And at the start, if it continues an interrupted session. One query is not enough,
because others may reconnect half a second later than we do, and on a loaded machine even later. So each cause plans
several queries (`QUERY_AFTER_...`). Their answers overlap, but that does no harm: every message has a number, and the
writer knows which ones it has.

How far back should it ask? The window of a query is relative ("the last 13 s"), and the publisher counts it back from
the arrival of the query, with its own clock. So it works even if that clock is wrong by an hour, unlike an absolute
time. But every delay of the query moves the window forward, and the oldest missing message falls out of it. So the
length of the window is computed anew for each key, just before its query, and has a margin for the delay.

Messages that cannot be fetched are not hidden: the writer counts them, the status shows the count, and `sessions
verify` lists the gaps.
"""

import threading
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import zenoh

from fleet.recording.writing.resume import RESUME_WINDOW_S
from schemas.bus import Bus

BACKFILL_POLL_INTERVAL_S: Final = 0.2
QUERY_AFTER_START_S: Final = (1.0,)
"""Delay of the query after the start. It is for publishers that started with us and may have missed our
subscription."""
QUERY_AFTER_RECONNECT_S: Final = (0.3, 1.0, 2.0, 4.0)
"""Delays of the queries after a reconnect. Other clients reconnect within half a second, or later on a loaded
machine."""
QUERY_AFTER_GAP_S: Final = (0.0, 1.0, 3.0)
GAP_MARGIN_S: Final = 2.0
"""Margin of a window for two delays of the network. The last message before the gap was published before it arrived, so
the gap may begin earlier than that. And the publisher counts the window back from the late arrival of the query."""
LEASE_POLLS: Final = round(2.0 / BACKFILL_POLL_INTERVAL_S)
"""Number of polls in 2 s. This is Zenoh's lease: only a silence of this time shows that a link is lost, so messages may
be missing since its beginning. Counted in polls, so that a stall of this process makes the window longer."""
MAX_SINGLE_KEYS: Final = 16
"""Maximum number of keys to query one by one. If there are more, query everything."""
MAX_ANSWERS: Final = 200_000
"""Maximum number of answers in the queue to the writer. The rest stays a gap, and is requested again."""


class Backfill:
    """Requests missed messages on its own thread, from `start` to `close`."""

    def __init__(self, bus: Bus, expressions: Sequence[str], *, resumes: bool) -> None:
        self._bus = bus
        # Do not ask for command streams: the clients that send them have no cache.
        self._all = tuple(expression for expression in expressions if "@cmd" not in expression)
        self._lock = threading.Lock()
        self._gaps: dict[str, float] = {}
        """Keys with the time from which messages are missing, s, monotonic."""
        self._answers: list[zenoh.Sample] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recall")
        now = time.monotonic()
        self._due = [now + after for after in ((0.0,) if resumes else ()) + QUERY_AFTER_START_S]
        """When the planned queries are due, s, monotonic."""
        self._missing_since = now - (RESUME_WINDOW_S if resumes else 0.0)
        """Time from which messages may be missing, s, monotonic."""
        self._query_all = True
        self._keys: set[str] = set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ask one last time for the messages that are still missing, and end the thread."""
        self._closing.set()
        self._thread.join()

    def request(self, keys: Mapping[str, float]) -> None:
        """Request a backfill of these keys. Each value is the age, in s, of the last message before the gap.

        The gap may be long: while a car is cut off, its gateway keeps publishing, and others hear it only afterwards.
        """
        now = time.monotonic()
        with self._lock:
            for key, age_s in keys.items():
                self._gaps[key] = min(now - age_s - GAP_MARGIN_S, self._gaps.get(key, now))

    def take_answers(self) -> list[zenoh.Sample]:
        """Return the answers since the last call. Some may be recorded already."""
        with self._lock:
            found, self._answers = self._answers, []
        return found

    def _run(self) -> None:
        hubs = self._bus.hubs
        polls = deque([time.monotonic()], LEASE_POLLS)
        connected_since = polls[0]
        while not self._closing.wait(BACKFILL_POLL_INTERVAL_S):
            now, connected = time.monotonic(), self._bus.hubs
            with self._lock:
                gaps, self._gaps = self._gaps, {}
            if gaps:
                self._plan(QUERY_AFTER_GAP_S, min([polls[0], *gaps.values()]), gaps)
            if connected and connected != hubs:
                self._plan(QUERY_AFTER_RECONNECT_S, connected_since, None)
            hubs = connected
            if connected:
                connected_since = polls[0]
            polls.append(now)
            if connected and self._due and self._due[0] <= now:
                self._due = [due for due in self._due if due > now]
                self._query()
                if not self._due:
                    self._query_all, self._keys = False, set()
        with self._lock:
            gaps = self._gaps
        if gaps or self._due:
            self._plan((), min([polls[0], *gaps.values()]), gaps or None)
            self._query()

    def _plan(self, after: Sequence[float], since: float, keys: Collection[str] | None) -> None:
        now = time.monotonic()
        self._missing_since = min(self._missing_since, since) if self._due else since
        self._due = sorted([*self._due, *(now + each for each in after)])
        if keys is None:
            self._query_all = True
        else:
            self._keys.update(keys)

    def _query(self) -> None:
        query_all = self._query_all or len(self._keys) > MAX_SINGLE_KEYS
        for expression in self._all if query_all else sorted(self._keys):
            found = []
            # Compute the window anew for each key: on a bad network, the answers for one key take seconds, and the
            # window of the next one would be too short.
            for sample in self._bus.recall(expression, time.monotonic() - self._missing_since):
                found.append(sample)
                if len(found) + len(self._answers) > MAX_ANSWERS:
                    break
            with self._lock:
                self._answers += found
