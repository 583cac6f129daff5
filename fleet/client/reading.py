"""Readings as an operator sees them: key, time, value; and a stream of them with a bounded queue. No Zenoh here."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final, Self, TypeAlias

from fleet.conditions import fields_of, value_in
from schemas import messages, topics
from schemas.bus import Sample

QUEUE_LIMIT: Final = 1024
"""Samples that wait for a reader."""
_LOOK_S: Final = 0.2
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Reading:
    """One message under one key."""

    key: str
    time: datetime
    """When its publisher had it, UTC: the message's own stamp, else the time Zenoh put on it."""
    value: Any
    """The protobuf message, e.g. `fleet.v1.Range`; optional fields that were not measured are not set."""

    @property
    def car(self) -> str:
        """The car's name; empty for what is the fleet's."""
        return getattr(self.value, "car", "")

    def __getitem__(self, field: str) -> Any:
        """A field of the message by name, as `range_m` or `hold.by`; None if it was not measured, or is not there.

        Of what is repeated, or a message of its own, whether it is there. Raises KeyError with the names there are.
        """
        known = fields_of(type(self.value))
        if field not in known:
            raise KeyError(f"{self.key} has no {field}; it has {', '.join(known)}")
        return value_in(self.value)(field)

    def age_s(self, now: datetime | None = None) -> float:
        """How old it is, s, by this machine's clock; at least 0, since clocks differ."""
        return max(0.0, ((now or datetime.now(UTC)) - self.time).total_seconds())

    def stale(self, now: datetime | None = None) -> bool:
        """Whether it is too old to say how things are (`stale_after_s` of its topic)."""
        topic = topics.of_key(self.key)
        return topic is not None and topic.stale_after_s is not None and self.age_s(now) > topic.stale_after_s

    def as_dict(self) -> dict[str, Any]:
        """The message in protobuf's JSON mapping, with the field names of the .proto."""
        return messages.to_dict(self.value)


Wanted: TypeAlias = Callable[[Reading], bool | None]
"""Which readings of a stream are wanted."""


def reading_of(sample: Sample) -> Reading:
    """The reading in a sample; raises messages.BadPayload or KeyError for what is no message of ours."""
    value: Any = sample.message()
    stamp = getattr(value, "stamp", None) or getattr(value, "timestamp", None)
    time_ns = stamp.seconds * 1_000_000_000 + stamp.nanos if stamp is not None and stamp.seconds else sample.time_ns
    return Reading(sample.key, _EPOCH + timedelta(microseconds=time_ns // 1000), value)


class Watch:
    """Readings as they come. Iterate; `close` (or `with`) ends it. A reader that is too slow loses the oldest."""

    def __init__(self, wanted: Wanted | None = None) -> None:
        self._wanted = wanted
        self._waiting: queue.Queue[Sample] = queue.Queue(QUEUE_LIMIT)
        self._closed = threading.Event()
        self._undeclare: Callable[[], object] = lambda: None
        self.dropped = 0
        """Samples that made room for newer ones."""
        self.unreadable = 0
        """Samples that are no message of ours."""

    def begin(self, subscribe: Callable[[Callable[[Sample], None]], Callable[[], object]]) -> Self:
        """Subscribe; what `subscribe` returns is called at the end."""
        self._undeclare = subscribe(self._take)
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Reading:
        while not self._closed.is_set():
            reading = self.within(_LOOK_S)
            if reading is not None:
                return reading
        raise StopIteration

    def within(self, seconds: float) -> Reading | None:
        """The next reading, waited for so long at most; None if there is none."""
        deadline = time.monotonic() + seconds
        while not self._closed.is_set():
            try:
                reading = reading_of(self._waiting.get(timeout=max(0.0, deadline - time.monotonic())))
            except queue.Empty:
                return None
            except (messages.BadPayload, KeyError):
                self.unreadable += 1
                continue
            if self._wanted is None or self._wanted(reading):
                return reading
        return None

    def close(self) -> None:
        """End the stream; the iteration stops."""
        if not self._closed.is_set():
            self._closed.set()
            self._undeclare()

    def _take(self, sample: Sample) -> None:
        """On the one Zenoh thread of this subscription: nobody else puts."""
        if self._waiting.full():
            with contextlib.suppress(queue.Empty):  # the reader was quicker
                self._waiting.get_nowait()
                self.dropped += 1
        self._waiting.put_nowait(sample)
