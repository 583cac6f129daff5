"""Tells what comes twice while a bus has two sessions, so that each message is handled once.

A bus opens its second session before it closes the first one (`Bus.reopen`). Meanwhile the hub sends every message and
every query to both, over two links: either may be first. So each is counted by what it is: on one side, a message is a
twin if the other side has had one more of it. Equal queries of two clients are not mixed up that way.
"""

import threading
from collections import Counter
from collections.abc import Hashable

import zenoh


class Overlap:
    """What has come over one of two sessions only."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._once: tuple[Counter[Hashable], Counter[Hashable]] = Counter(), Counter()
        self.older_is_deaf = False
        """True once everything comes over the newer session: nothing counts over the older one then."""

    def is_twin(self, what: Hashable, *, newer: bool) -> bool:
        """Return True if the same has come over the other session. newer: over which session it came."""
        with self._lock:
            if self.older_is_deaf and not newer:
                return True
            own, other = self._once[newer], self._once[not newer]
            if other[what] > 0:
                other[what] -= 1
                return True
            del other[what]
            if not self.older_is_deaf:
                own[what] += 1
            return False


def mark_of_sample(declaration: int, sample: zenoh.Sample) -> Hashable:
    """Return what tells a sample from others. Its time is that of its sender, or of the first hub."""
    stamp = sample.timestamp
    when = None if stamp is None else (stamp.get_time_as_ntp64().as_nanos(), str(stamp.get_id()))
    return declaration, str(sample.key_expr), when


def mark_of_query(declaration: int, query: zenoh.Query) -> Hashable:
    """Return what tells a query from others: equal ones are counted."""
    payload = query.payload
    return declaration, str(query.selector), b"" if payload is None else payload.to_bytes()
