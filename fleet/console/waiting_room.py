"""The connections from the network that were accepted and wait for TLS. Pure: time is an argument (s, monotonic).

A TLS handshake takes some milliseconds of the loop that stops the cars, so each address may begin only a limited number
of them. But a whole class has one address behind its access point, and one client that floods must not lock the rest of
the class out. So connections over the rate are not closed: they wait in the line of their address. If places run out,
the oldest connection that has sent nothing loses its place first, because an honest client sends its TLS hello at once.
Connections with a hello are served in order, so a client that connects again and again waits behind everybody else each
time.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Final

from msgspec import Struct, field

from schemas.token_bucket import TokenBucket

ADDRESS_BURST: Final = 300.0
"""Handshakes of one address at once. A class behind one address opens forty pages, with seven connections each."""
ADDRESS_RATE: Final = 20.0
"""Handshakes of one address per second. With one request each, they take some 8 % of a core."""
TOTAL_BURST: Final = 1000.0
"""Handshakes of all addresses at once. Even if three addresses flood, some are left for the rest."""
TOTAL_RATE: Final = 100.0
MAX_HANDSHAKES_PER_ADDRESS: Final = 16
"""Maximum number of unfinished handshakes of one address. It is less than the 24 strangers that an address may have
(`connection_limit`)."""
MAX_WAITING_PER_ADDRESS: Final = 160
"""Maximum number of connections in one line. In a flood of 1000 connections a second without a hello, an honest client
has 0.16 s to send its hello."""
MAX_WAITING: Final = 224
"""Maximum number of connections in all lines. Together with the open connections they are fewer than the 1024 files of
a process."""
HELLO_TIMEOUT_S: Final = 10.0
"""Timeout of a connection that sends nothing: the same as for a stranger (`connection_limit`)."""
MAX_ADDRESSES: Final = 1024
"""Maximum number of remembered addresses. Beyond it, an address without a connection is forgotten."""


class _AddressLine(Struct):
    """The connections of one address."""

    budget: TokenBucket = field(default_factory=lambda: TokenBucket(ADDRESS_RATE, ADDRESS_BURST))
    silent: dict[Hashable, float] = field(default_factory=dict)
    """When each connection without a hello came, the oldest first."""
    ready: dict[Hashable, None] = field(default_factory=dict)
    """The connections with a hello, the oldest first."""
    begun: int = 0
    """Number of handshakes under way."""

    def __len__(self) -> int:
        return len(self.silent) + len(self.ready)


class WaitingRoom(Struct):
    """The lines by address. `choose` returns a random one of some connections."""

    choose: Callable[[Sequence[Hashable]], Hashable]
    _lines: dict[str, _AddressLine] = field(default_factory=dict)
    _total: TokenBucket = field(default_factory=lambda: TokenBucket(TOTAL_RATE, TOTAL_BURST))

    def add(self, key: Hashable, address: str, now: float) -> Hashable | None:
        """Add a connection. Return the key of the connection that loses its place for it, perhaps the new one's."""
        line = self._lines.setdefault(address, _AddressLine())
        line.silent[key] = now
        self._forget_idle()
        if len(line) > MAX_WAITING_PER_ADDRESS:
            return self._drop_one(line)
        if len(self) > MAX_WAITING:
            return self._drop_one(max(self._lines.values(), key=len))
        return None

    def on_hello(self, key: Hashable, address: str) -> None:
        """Note that a connection has sent its TLS hello."""
        line = self._lines.get(address)
        if line is not None and line.silent.pop(key, None) is not None:
            line.ready[key] = None

    def remove(self, key: Hashable, address: str) -> None:
        """Forget a connection that has gone."""
        if (line := self._lines.get(address)) is not None:
            line.silent.pop(key, None)
            line.ready.pop(key, None)

    def take(self, now: float) -> Hashable | None:
        """Return the connection whose handshake begins now, or None if none may begin. The addresses take turns."""
        if not self._total.has(now):
            return None
        for address, line in self._lines.items():
            if line.ready and line.begun < MAX_HANDSHAKES_PER_ADDRESS and line.budget.take_one(now):
                self._total.take_one(now)
                key = next(iter(line.ready))
                del line.ready[key]
                line.begun += 1
                self._lines[address] = self._lines.pop(address)  # this address comes last in the next round
                return key
        return None

    def on_begun(self, address: str) -> None:
        """Note the end of a handshake, good or bad."""
        self._lines[address].begun -= 1

    def expire(self, now: float) -> list[Hashable]:
        """Remove the connections that have sent nothing for too long. Return their keys."""
        late = []
        for line in self._lines.values():
            old = [key for key, since in line.silent.items() if now - since >= HELLO_TIMEOUT_S]
            for key in old:
                del line.silent[key]
            late += old
        return late

    @property
    def has_ready(self) -> bool:
        """True if a connection with a hello waits."""
        return any(line.ready for line in self._lines.values())

    def __len__(self) -> int:
        return sum(len(line) for line in self._lines.values())

    def _drop_one(self, line: _AddressLine) -> Hashable:
        """Free a place: that of the oldest connection without a hello, or else that of any connection."""
        if line.silent:
            key = next(iter(line.silent))
            del line.silent[key]
        else:
            key = self.choose(list(line.ready))
            del line.ready[key]
        return key

    def _forget_idle(self) -> None:
        if len(self._lines) > MAX_ADDRESSES:
            idle = next((address for address, line in self._lines.items() if len(line) + line.begun == 0), None)
            if idle is not None:
                del self._lines[idle]
