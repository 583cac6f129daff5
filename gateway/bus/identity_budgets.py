"""Limits how many messages of each identity a gateway reads, so that one person's flood does not use up its time.

On a bus with certificates, each drive of a stream has the sender's identity in its key. Only the key is read here, so a
message over the budget costs one callback, but no copy and no turn of the loop. The budget is ten times what a joystick
sends. On a bus without certificates, the sender is only known after a message was read, and may use any name. So there,
only the queue behind this limits a flood.
"""

from typing import Final

from schemas import keys
from schemas.token_bucket import TokenBucket

DRIVES_PER_S: Final = 200.0
"""Maximum drives of one identity in the long run. A page or a joystick sends ten to twenty a second."""
DRIVES_AT_ONCE: Final = 64
"""Maximum drives of one identity at once: a network that stood still for some seconds delivers so many."""
MAX_IDENTITIES: Final = 256
"""Maximum remembered identities. Only identities with a certificate of the hub can be here, so this is enough."""


class IdentityBudgets:
    """The budgets of all identities. Times: s, monotonic."""

    def __init__(self, per_s: float = DRIVES_PER_S, at_once: float = DRIVES_AT_ONCE) -> None:
        self._per_s = per_s
        self._at_once = at_once
        self._buckets: dict[str, TokenBucket] = {}
        self.dropped = 0
        """Number of messages over a budget."""

    def take(self, key: str, now: float) -> bool:
        """Return True if a message under this key is within the budget of its identity, and count it."""
        identity = keys.identity_of(key)
        if not identity:
            return True
        bucket = self._buckets.get(identity)
        if bucket is None:
            if len(self._buckets) >= MAX_IDENTITIES:
                del self._buckets[next(iter(self._buckets))]
            bucket = self._buckets[identity] = TokenBucket(self._per_s, self._at_once)
        if bucket.take_one(now):
            return True
        self.dropped += 1
        return False
