"""Recognizes the second copy of a message while a bus has two sessions, so that each message is handled once.

A bus opens its second session before it closes the first one (`Bus.reopen`). Meanwhile the hub sends every message and
every query to both, over two links: either copy may be first. So copies are counted by content: a message is a twin if
the other session has delivered the same content once more than this one. Equal queries of two clients still count as
two.

Suppose a query came over the first session just before the hub learned of the second session. Then it has no twin, and
is forgotten after `TWIN_S`: else the next equal query, such as the same stop once more, would be taken for its twin and
dropped. Published messages need no such limit: each has a time stamp, so no two are equal.
"""

import threading
from collections import deque
from collections.abc import Hashable
from math import inf
from typing import Final

import zenoh

TWIN_S: Final = 0.3
"""Maximum time between the two copies of a query, which the hub sends at once over two links to one computer."""


class Overlap:
    """The messages that have come over only one of two sessions, and when. Times: s, monotonic."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._once: tuple[dict[Hashable, deque[float]], dict[Hashable, deque[float]]] = {}, {}
        self.older_is_deaf = False
        """True once the older session is ignored: everything comes over the newer one, and whatever still comes over
        the older one is dropped."""

    def is_twin(self, what: Hashable, now: float, *, newer: bool, within_s: float = inf) -> bool:
        """Return True if the same message has come over the other session at most `within_s` ago.

        With `newer`, this message came over the newer session. Otherwise also return True if `older_is_deaf`.
        """
        with self._lock:
            if self.older_is_deaf and not newer:
                return True
            own, other = self._once[newer], self._once[not newer]
            came = other.pop(what, deque())
            while came and came[0] < now - within_s:
                came.popleft()
            if came:
                came.popleft()
                if came:
                    other[what] = came
                return True
            if not self.older_is_deaf:
                own.setdefault(what, deque()).append(now)
            return False


def mark_of_sample(declaration: int, sample: zenoh.Sample) -> Hashable:
    """Return the mark of a sample: no other sample has it. The time stamp is from the sender, or from the first hub."""
    stamp = sample.timestamp
    when = None if stamp is None else (stamp.get_time_as_ntp64().as_nanos(), str(stamp.get_id()))
    return declaration, str(sample.key_expr), when


def mark_of_query(declaration: int, query: zenoh.Query) -> Hashable:
    """Return the mark of a query. Equal queries have the same mark, so `Overlap` counts them."""
    payload = query.payload
    return declaration, str(query.selector), b"" if payload is None else payload.to_bytes()
