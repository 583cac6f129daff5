"""Remembers which publishers' clocks are slow, to judge the publish times of backfilled messages. Pure.

A message of before the recording must not be taken from a publisher's cache. The publish time tells, but by the clock
of the publisher: on a small computer without a battery for its clock, this may be minutes or years behind. Live
messages show it, because they are received a moment after they were published. A clock that is ahead cannot be seen
there, because Zenoh replaces its times, and need not be: a query asks for a length of time, not for a time.
"""

from typing import Final

from fleet.recording.writing.backfill_plan import source_of

MIN_BEHIND_NS: Final = 1_000_000_000
"""Messages that are received later than this after their publish time show a slow clock. Less may be delay."""


class PublisherClocks:
    """How far the clocks of cars and services are behind the recorder's."""

    def __init__(self) -> None:
        self._behind: dict[str, int] = {}
        """By car or service: the smallest time, ns, from publishing to receiving."""

    def add(self, key: str, published_ns: int, received_ns: int) -> None:
        """Add a message that was received live. Most messages of a publisher may be left out."""
        source, behind_ns = source_of(key), received_ns - published_ns
        self._behind[source] = min(self._behind.get(source, behind_ns), behind_ns)

    def received_ns(self, key: str, published_ns: int) -> int:
        """Return about when a message would have been received live, by the recorder's clock."""
        behind_ns = self._behind.get(source_of(key), 0)
        return published_ns + (behind_ns if behind_ns > MIN_BEHIND_NS else 0)
