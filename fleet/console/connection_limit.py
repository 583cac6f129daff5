"""How many connections from the network the console keeps. Pure: time is an argument (s, monotonic).

Strangers must not use up the file descriptors and the time of the process that stops the cars.
"""

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final

from schemas.token_bucket import TokenBucket

MAX_CONNECTIONS: Final = 640
"""Maximum number of connections from the network: forty devices that take all they may."""
MAX_PER_DEVICE: Final = 16
"""Maximum number of connections of one paired device: a browser opens six for requests, and one for each tab."""
MAX_STRANGERS_PER_ADDRESS: Final = 24
STRANGER_TIMEOUT_S: Final = 10.0
"""Timeout of a connection that has shown no cookie of a paired device."""
# A TLS handshake takes a millisecond or two of the loop that stops the cars.
ADDRESS_BURST: Final = 300.0
"""New connections of one address at once: a class behind one address opens forty pages, with seven connections each."""
ADDRESS_RATE: Final = 10.0
"""New connections per second of one address."""
TOTAL_BURST: Final = 1000.0
"""The same of all addresses. Three that flood leave some for the others."""
TOTAL_RATE: Final = 50.0
MAX_ADDRESSES: Final = 1024
"""Maximum number of remembered addresses. More are forgotten, the oldest first."""


@dataclass(slots=True)
class _OpenConnection:
    address: str
    since_s: float
    device: str = ""
    """The paired device whose cookie it has shown; empty: none."""


@dataclass(slots=True)
class ConnectionLimit:
    """The open connections, oldest first, by any key."""

    _open: dict[Hashable, _OpenConnection] = field(default_factory=dict)
    _total: TokenBucket = field(default_factory=lambda: TokenBucket(TOTAL_RATE, TOTAL_BURST))
    _addresses: dict[str, TokenBucket] = field(default_factory=dict)

    def admit(self, key: Hashable, address: str, now: float) -> tuple[bool, Hashable | None]:
        """Decide on a new connection. Return whether it stays, and the key of another one that must end for it."""
        budget = self._addresses.pop(address, None) or TokenBucket(ADDRESS_RATE, ADDRESS_BURST)
        self._addresses[address] = budget
        if len(self._addresses) > MAX_ADDRESSES:
            del self._addresses[next(iter(self._addresses))]
        # One address in a flood uses up its own budget, not that of all.
        if not budget.take_one(now) or not self._total.take_one(now):
            return False, None
        strangers = [other for other, each in self._open.items() if not each.device]
        neighbors = [other for other in strangers if self._open[other].address == address]
        ended: Hashable | None = None
        if len(neighbors) >= MAX_STRANGERS_PER_ADDRESS:
            ended = neighbors[0]
        elif len(self._open) >= MAX_CONNECTIONS:
            if not strangers:
                return False, None
            ended = strangers[0]
        if ended is not None:
            del self._open[ended]
        self._open[key] = _OpenConnection(address, now)
        return True, ended

    def on_paired(self, key: Hashable, device: str) -> bool:
        """Keep a connection: it has shown the cookie of a paired device. Return False if the device has too many."""
        found = self._open.get(key)
        if found is None or found.device == device:
            return True
        if sum(each.device == device for each in self._open.values()) >= MAX_PER_DEVICE:
            del self._open[key]
            return False
        found.device = device
        return True

    def on_closed(self, key: Hashable) -> None:
        """Forget a connection."""
        self._open.pop(key, None)

    def expire(self, now: float) -> list[Hashable]:
        """Remove the connections of strangers that have lasted too long. Return their keys."""
        late = [key for key, each in self._open.items() if not each.device and now - each.since_s >= STRANGER_TIMEOUT_S]
        for key in late:
            del self._open[key]
        return late

    def __len__(self) -> int:
        return len(self._open)


@dataclass(slots=True)
class LogLimit:
    """Lets one message pass for each interval, and counts the others."""

    interval_s: float = 10.0
    _last: float | None = None
    _left_out: int = 0

    def words(self, words: str, now: float) -> str | None:
        """Return what to log: the words, with the number of messages left out before. None: nothing."""
        if self._last is not None and now - self._last < self.interval_s:
            self._left_out += 1
            return None
        more = f" ({self._left_out} more since the last message)" if self._left_out else ""
        self._last, self._left_out = now, 0
        return f"{words}{more}"
