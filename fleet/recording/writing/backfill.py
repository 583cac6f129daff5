"""Requests messages that a recorder missed from the caches of their publishers. session_writer.py drops duplicates.

A recording with holes is worst exactly where it matters: the moment when the network broke is the moment that somebody
will want to look at. A subscriber alone cannot help that, since what was published while it was away is gone. So each
publisher keeps what it said last: ten seconds at the rate of its topic, at least a hundred publications
(`Topic.cache_size`), which is minutes of a state and hours of an event.

When to ask? After the recorder's own link to the hub is back; after a gap in the numbers of a publisher, which is how
one notices that it was the *car* that was cut off; and at the start, when an interrupted session goes on. One question
is not enough. Others reconnect half a second later than we do, and on a loaded machine later still, so each cause plans
several questions (`QUERY_AFTER_...`). The answers overlap, and that is fine: every message has a number, and the writer
knows which ones it has.

From when on? The window of a question is relative ("the last 13 s") and is counted by the publisher when the question
arrives, with its own clock. That survives a clock that is wrong by an hour, which an absolute time would not. But it
means that every delay of the question moves the window on, at the end where the oldest missing message is. So the
length is counted anew for each key, right before it is asked, and has a margin for the way.

What cannot be had again is said: the writer counts it, the status shows it, and `sessions verify` names it.
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
"""Delay of the query after the start: a publisher that started with us may have missed our subscription."""
QUERY_AFTER_RECONNECT_S: Final = (0.3, 1.0, 2.0, 4.0)
"""Delays of the queries after a reconnect: others retry within half a second, and a loaded machine delays them."""
QUERY_AFTER_GAP_S: Final = (0.0, 1.0, 3.0)
GAP_MARGIN_S: Final = 2.0
"""Time that the network may have taken for the last message before a gap, and takes for the query: a publisher counts
the window from when the query arrives."""
LEASE_POLLS: Final = round(2.0 / BACKFILL_POLL_INTERVAL_S)
"""Number of polls that cover Zenoh's 2 s lease. Counted in polls because a stalled process does not poll."""
MAX_SINGLE_KEYS: Final = 16
"""Maximum keys to query one by one. For more keys, query everything."""
MAX_ANSWERS: Final = 200_000
"""Maximum answers in the queue to the writer. The rest is a gap again, and requested again."""


class Backfill:
    """Requests missed messages on its own thread, from `start` to `close`."""

    def __init__(self, bus: Bus, expressions: Sequence[str], *, resumes: bool) -> None:
        self._bus = bus
        # Clients that send command streams have no cache.
        self._all = tuple(expression for expression in expressions if "@cmd" not in expression)
        self._lock = threading.Lock()
        self._gaps: dict[str, float] = {}
        """Keys with the time from which messages are missing, s, monotonic."""
        self._answers: list[zenoh.Sample] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recall")
        now = time.monotonic()
        self._due = [now + after for after in ((0.0,) if resumes else ()) + QUERY_AFTER_START_S]
        self._missing_since = now - (RESUME_WINDOW_S if resumes else 0.0)
        self._query_all = True
        self._keys: set[str] = set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Request messages that are still missing a last time, and end the thread."""
        self._closing.set()
        self._thread.join()

    def request(self, keys: Mapping[str, float]) -> None:
        """Request a backfill of these keys. Values: age of the last message before the gap, s.

        A car may have been cut off for long. Its gateway goes on, and others hear it again only after that.
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
            # Counted anew for each: on a bad network the answers to one take seconds, and its window would move on.
            for sample in self._bus.recall(expression, time.monotonic() - self._missing_since):
                found.append(sample)
                if len(found) + len(self._answers) > MAX_ANSWERS:
                    break
            with self._lock:
                self._answers += found
