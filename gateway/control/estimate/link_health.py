"""Whether the car is heard: from its own bytes, never from a library's word that it is connected."""

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

BYTES_PER_S: Final = 960  # docs/reference/protocol.md#framing: UART 9600 8N1
AIRTIME_WINDOW_S: Final = 10.0
STALE_S: Final = 3.0


class LinkState(StrEnum):
    """`quiet`: silence is expected in this mode; `stale`: it is not; `lost`: the port is gone."""

    ONLINE = "online"
    QUIET = "quiet"
    STALE = "stale"
    LOST = "lost"


@dataclass(slots=True)
class LinkHealth:
    """State and counters of one link. Times are seconds on one monotonic clock."""

    state: LinkState = LinkState.LOST
    reason: str = "not connected yet"
    since: float = 0.0
    rx_bytes: int = 0
    tx_bytes: int = 0
    rx_frames: int = 0
    tx_frames: int = 0
    rejects: dict[str, int] = field(default_factory=dict)
    reconnects: int = 0
    last_rx_at: float | None = None
    """When the last bytes came."""
    last_reading_at: float | None = None
    """When the last reading came: bytes that are none do not make a link online."""
    _up_at: float | None = None
    _writes: deque[tuple[float, int]] = field(default_factory=deque)

    def up(self, now: float) -> None:
        """The port is open."""
        self.reconnects += self._up_at is not None
        self._up_at = now
        self.last_rx_at = self.last_reading_at = None
        self._set(LinkState.STALE, "open, nothing heard yet", now)

    def down(self, reason: str, now: float) -> None:
        """The port is gone."""
        self._set(LinkState.LOST, reason, now)

    def received(self, count: int, now: float) -> None:
        """Bytes came."""
        self.rx_bytes += count
        self.last_rx_at = now

    def heard(self, at: float) -> None:
        """Take that a reading came."""
        self.last_reading_at = at

    def rejected(self, cause: str, count: int = 1) -> None:
        """Bytes were no reading."""
        self.rejects[cause] = self.rejects.get(cause, 0) + count

    def wrote(self, count: int, now: float) -> None:
        """A frame was written."""
        self.tx_bytes += count
        self.tx_frames += 1
        self._writes.append((now, count))
        while self._writes and self._writes[0][0] < now - AIRTIME_WINDOW_S:
            self._writes.popleft()

    def airtime(self, now: float) -> float:
        """Share of the last ten seconds that our frames took on the wire, 0..1."""
        sent = sum(count for at, count in self._writes if at >= now - AIRTIME_WINDOW_S)
        return min(1.0, sent / (BYTES_PER_S * AIRTIME_WINDOW_S))

    def judge(self, *, now: float, limit_s: float | None, unheard_s: float, why_quiet: str, is_heard: bool) -> bool:
        """Bring the state up to date. Return True on a change.

        `limit_s`: the longest normal silence, None if any is. `unheard_s`: how long there was no reading, what our own
        frames explain left out (see `ModeTruth`). `is_heard`: False once control counts the car as unheard.
        """
        if self.state is LinkState.LOST:
            return False
        before = self.state
        up_at = self._up_at if self._up_at is not None else now
        heard = self.last_reading_at is not None
        silence_s = max(0.0, now - (self.last_reading_at if self.last_reading_at is not None else up_at))
        if is_heard and heard and silence_s <= (limit_s if limit_s is not None else STALE_S):
            self._set(LinkState.ONLINE, "heard", now)
        elif not is_heard:
            self._set(LinkState.STALE, f"not heard for {silence_s:.1f} s: whether it moves is not known", now)
        elif limit_s is None:
            self._set(LinkState.QUIET, why_quiet, now)
        elif min(silence_s, unheard_s) <= limit_s:
            if heard:
                self._set(LinkState.QUIET, "the car is busy", now)
        else:
            self._set(LinkState.STALE, f"nothing heard for {silence_s:.1f} s, expected every {limit_s:g} s", now)
        return self.state is not before

    def _set(self, state: LinkState, reason: str, now: float) -> None:
        if state is not self.state:
            self.since = now
        self.state = state
        self.reason = reason
