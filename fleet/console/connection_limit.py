"""How many connections from the network the console keeps. Pure: time is an argument (s, monotonic).

A connection is counted here from the moment when it begins TLS. `waiting_room` decides when that is. Strangers must not
use up the file descriptors and the time of the process that stops the cars.
"""

from collections.abc import Hashable
from typing import Final

from msgspec import Struct, field

MAX_CONNECTIONS: Final = 640
"""Maximum number of connections from the network: forty devices, each with as many as it may have."""
MAX_PER_DEVICE: Final = 16
"""Maximum number of connections of one paired device: a browser opens six for requests, and one for each tab."""
MAX_STRANGERS_PER_ADDRESS: Final = 24
STRANGER_TIMEOUT_S: Final = 10.0
"""Timeout of a connection that has shown no cookie of a paired device."""


class _OpenConnection(Struct):
    address: str
    since_s: float
    device: str = ""
    """The paired device whose cookie the connection has shown. Empty if it has shown none."""


class ConnectionLimit(Struct):
    """The open connections, oldest first, by any key."""

    _open: dict[Hashable, _OpenConnection] = field(default_factory=dict)

    def admit(self, key: Hashable, address: str, now: float) -> tuple[bool, Hashable | None]:
        """Decide on a new connection.

        Return whether it stays, and the key of another connection that must end for it.
        """
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
        """Keep a connection that has shown the cookie of a paired device. Return False if the device has too many."""
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


class LogLimit(Struct):
    """Lets one message pass in each interval, and counts the messages that it holds back."""

    interval_s: float = 10.0
    _last: float | None = None
    _left_out: int = 0

    def words(self, words: str, now: float) -> str | None:
        """Return what to log: the words, with the number of messages left out before.

        None means that nothing is to be logged.
        """
        if self._last is not None and now - self._last < self.interval_s:
            self._left_out += 1
            return None
        more = f" ({self._left_out} more since the last message)" if self._left_out else ""
        self._last, self._left_out = now, 0
        return f"{words}{more}"
