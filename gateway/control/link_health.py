"""Rates the link by the bytes from the car, and never by a library's claim that it is connected."""

from collections import deque
from typing import Final

from msgspec import Struct, field

from schemas.words import LinkState

AIRTIME_WINDOW_S: Final = 10.0
"""Period over which `airtime` is measured."""
STALE_S: Final = 3.0
"""A link is no longer online after a silence of this length, if its driver sets no limit because every silence is
normal."""


class LinkHealth(Struct):
    """State and counters of one link. Times: s, monotonic."""

    state: LinkState = LinkState.LOST
    reason: str = "not connected yet"
    since: float = 0.0
    rx_bytes: int = 0
    tx_bytes: int = 0
    rx_frames: int = 0
    tx_frames: int = 0
    bytes_per_s: float = 960.0
    """The rate of the car's own wire, bytes/s: 9600 baud, unless its driver says otherwise."""
    rejects: dict[str, int] = field(default_factory=dict)
    reconnects: int = 0
    last_rx_at: float | None = None
    """When the last bytes arrived."""
    last_reading_at: float | None = None
    """When the last reading arrived. Other bytes do not make a link online."""
    _up_at: float | None = None
    _writes: deque[tuple[float, int]] = field(default_factory=deque)

    def on_open(self, now: float) -> None:
        """Record that the port is open."""
        self.reconnects += self._up_at is not None
        self._up_at = now
        self.last_rx_at = self.last_reading_at = None
        self._set(LinkState.STALE, "open, no reading yet", now)

    def on_lost(self, reason: str, now: float) -> None:
        """Record that the port is closed."""
        self._set(LinkState.LOST, reason, now)

    def on_bytes(self, count: int, now: float) -> None:
        """Count received bytes."""
        self.rx_bytes += count
        self.last_rx_at = now

    def on_reading(self, at: float) -> None:
        """Record the time of a reading."""
        self.last_reading_at = at

    def on_rejected(self, cause: str, count: int = 1) -> None:
        """Count frames or bytes that are not readings or were not used, or a trouble of the link, by cause."""
        self.rejects[cause] = self.rejects.get(cause, 0) + count

    def on_written(self, count: int, now: float) -> None:
        """Count a written frame."""
        self.tx_bytes += count
        self.tx_frames += 1
        self._writes.append((now, count))
        while self._writes and self._writes[0][0] < now - AIRTIME_WINDOW_S:
            self._writes.popleft()

    def airtime(self, now: float) -> float:
        """Return the share of the last ten seconds that our frames took on the wire, 0..1."""
        sent = sum(count for at, count in self._writes if at >= now - AIRTIME_WINDOW_S)
        return min(1.0, sent / (self.bytes_per_s * AIRTIME_WINDOW_S))

    def update(self, *, now: float, limit_s: float | None, unheard_s: float, why_quiet: str, is_heard: bool) -> bool:
        """Update the state. Return True on a change.

        `limit_s` is the longest normal silence, or None if every silence is normal. `unheard_s` is the time without a
        reading, less the time in which our frames keep the car too busy to report (see `ModeEstimator`). `is_heard` is
        False if the driver counts the car as silent.
        """
        if self.state is LinkState.LOST:
            return False
        before = self.state
        up_at = self._up_at if self._up_at is not None else now
        has_reading = self.last_reading_at is not None
        silence_s = max(0.0, now - (self.last_reading_at if self.last_reading_at is not None else up_at))
        if is_heard and has_reading and silence_s <= (limit_s if limit_s is not None else STALE_S):
            self._set(LinkState.ONLINE, "readings arrive", now)
        elif not is_heard:
            self._set(LinkState.STALE, f"no reading for {silence_s:.1f} s: it may be moving", now)
        elif limit_s is None:
            self._set(LinkState.QUIET, why_quiet, now)
        elif min(silence_s, unheard_s) <= limit_s:
            if has_reading:
                self._set(LinkState.QUIET, "the car is busy", now)
        else:
            self._set(LinkState.STALE, f"no reading for {silence_s:.1f} s, expected every {limit_s:g} s", now)
        return self.state is not before

    def _set(self, state: LinkState, reason: str, now: float) -> None:
        if state is not self.state:
            self.since = now
        self.state = state
        self.reason = reason
