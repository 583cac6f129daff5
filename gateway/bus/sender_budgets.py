"""Limits how many messages of each sender a gateway reads, so that a flood does not use up its time.

A message over the budget costs one callback, but no copy and no turn of the loop. For that, the sender must be known
before the message is read. On a bus with certificates, each drive of a stream has its sender's identity in its key, so
all sessions of one identity share a budget. On a bus without certificates, the sender is the Zenoh session that
published the message. Messages without an identity and without a session share one budget.

Without budgets, Zenoh's queue for the callback fills up. Then Zenoh reads nothing from the hub, and a stop waits there.
The budget is ten times what a joystick sends.
"""

from typing import Final

from schemas import keys
from schemas.token_bucket import TokenBucket

DRIVES_PER_S: Final = 200.0
"""Maximum drives of one sender in the long run. A page or a joystick sends ten to twenty a second."""
DRIVES_AT_ONCE: Final = 64
"""Maximum drives of one sender at once: a network that stood still for some seconds delivers so many."""
MAX_SENDERS: Final = 256
"""Maximum remembered senders. The one that was first seen is forgotten for a new one."""


class SenderBudgets:
    """The budgets of all senders. Times: s, monotonic."""

    def __init__(self) -> None:
        self._buckets: dict[str, TokenBucket] = {}
        self.dropped = 0
        """Number of messages over a budget."""

    def take(self, key: str, session: str, now: float) -> bool:
        """Return True if a message is within the budget of its sender, and count it.

        `session` is the id of the Zenoh session that published it under `key`, or an empty text.
        """
        sender = keys.identity_of(key) or session
        bucket = self._buckets.get(sender)
        if bucket is None:
            if len(self._buckets) >= MAX_SENDERS:
                del self._buckets[next(iter(self._buckets))]
            bucket = self._buckets[sender] = TokenBucket(DRIVES_PER_S, DRIVES_AT_ONCE)
        if bucket.take_one(now):
            return True
        self.dropped += 1
        return False
