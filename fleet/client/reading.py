"""Readings (key, time, value), and a stream of them with a bounded queue. No Zenoh here."""

import contextlib
import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from html import escape
from math import inf
from typing import Any, Final, Self, TypeAlias

from fleet.conditions import fields_of, value_in
from schemas import messages, topics
from schemas.bus import Sample
from schemas.local_time import exact

READING_QUEUE_LIMIT: Final = 1024
"""Maximum number of queued samples."""
MAX_STAMP_AHEAD_S: Final = 10.0
"""Maximum time by which a stamp may lie in the future. The clocks of two computers differ by less if NTP sets them."""
_CLOSE_POLL_S: Final = 0.2
"""Interval at which a waiting reader notices that the stream was closed."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def age_of_answer_s(stamp_s: float, now: float) -> float:
    """Return the age of an answer to a query, by its stamp. Both times are in s since the epoch.

    A stamp that is slightly ahead gives 0, because clocks differ. A stamp that is far ahead gives infinity: a clock was
    set back after the answer was stamped, so the value may be of any age.
    """
    return inf if stamp_s - now > MAX_STAMP_AHEAD_S else max(0.0, now - stamp_s)


_HEADER: Final = frozenset({"stamp", "timestamp", "car", "seq", "boot_id"})
"""Header fields, which are not shown. Logs have only `timestamp`, other messages all the others."""
_NOT_MEASURED: Final = "<span title='not measured'>\u2014</span>"


@dataclass(frozen=True, slots=True, repr=False)
class Reading:
    """One message under one key. A notebook shows it as a table."""

    key: str
    time: datetime
    """The message's stamp, or its Zenoh timestamp if it has no stamp. UTC."""
    value: Any
    """The protobuf message, e.g. `fleet.v1.Range`. Optional fields that were not measured are not set."""

    @classmethod
    def of(cls, key: str, value: Any, time_ns: int) -> Self:
        """Return the reading of a message. If the message has no stamp, its time is `time_ns` (ns since the epoch)."""
        stamp = getattr(value, "stamp", None) or getattr(value, "timestamp", None)
        if stamp is not None and stamp.seconds:
            time_ns = messages.stamp_ns(stamp)
        return cls(key, _EPOCH + timedelta(microseconds=time_ns // 1000), value)

    @property
    def car(self) -> str:
        """The car's name, or that of a service such as `@coordinator`. Empty for logs: no message of one names it."""
        return getattr(self.value, "car", "")

    def __getitem__(self, field: str) -> Any:
        """Return the value of a field, such as `range_m` or `hold.by`. None if it was not measured or is not set.

        For a list, return True if it has elements. For a part of a message, such as `hold`, return True if it is set.
        Raises KeyError if there is no such field; the error lists the fields.
        """
        known = fields_of(type(self.value))
        if field not in known:
            raise KeyError(f"{self.key} has no {field}; it has {', '.join(known)}")
        return value_in(self.value)(field)

    def age_s(self, now: datetime | None = None) -> float:
        """Return the age, s, by this machine's clock. Return 0 if it would be negative, as the clocks may differ."""
        return max(0.0, ((now or datetime.now(UTC)) - self.time).total_seconds())

    def stale(self, now: datetime | None = None) -> bool:
        """Return True if the reading is too old for its topic, or if its stamp is far in the future."""
        topic = topics.of_key(self.key)
        if topic is None or topic.stale_after_s is None:
            return False
        return age_of_answer_s(self.time.timestamp(), (now or datetime.now(UTC)).timestamp()) > topic.stale_after_s

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={'not measured' if text is None else text}" for name, text in self._fields())
        return f"<{self.key} {self._clock}: {fields}>"

    def _repr_html_(self) -> str:
        cell = "<tr><th style='text-align:left'>{}</th><td style='text-align:left'>{}</td></tr>"
        rows = [cell.format(name, _NOT_MEASURED if text is None else escape(text)) for name, text in self._fields()]
        return f"<table><caption>{escape(self.key)}, {self._clock}</caption>{''.join(rows)}</table>"

    @property
    def _clock(self) -> str:
        since = self.time - _EPOCH
        return exact((since // timedelta(microseconds=1)) * 1000)

    def _fields(self) -> Iterator[tuple[str, str | None]]:
        """Yield the fields with their values as text and their units, or None if not measured."""
        topic = topics.of_key(self.key)
        values = self.as_dict()
        for field in self.value.DESCRIPTOR.fields:
            if field.name in _HEADER:
                continue
            if field.has_presence and not self.value.HasField(field.name):
                yield field.name, None
                continue
            value = values.get(field.name)
            unit = topic.units.get(field.name, "") if topic is not None else ""
            text = f"{value:g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
            yield field.name, text if unit in ("", "1") else f"{text} {unit}"

    def as_dict(self) -> dict[str, Any]:
        """Return the message in protobuf's JSON mapping, with the field names of the .proto."""
        return messages.to_dict(self.value)


ReadingFilter: TypeAlias = Callable[[Reading], bool | None]
"""Returns True to keep a reading of a stream. False, or None for unknown, drops it."""


def reading_of(sample: Sample) -> Reading:
    """Return the reading in a sample. Raises messages.BadPayload or KeyError if it is not a message of this schema."""
    return Reading.of(sample.key, sample.message(), sample.time_ns)


class Watch:
    """A stream of readings to iterate over. `close` (or `with`) ends it.

    If readings arrive faster than you take them, the oldest ones are dropped.
    """

    def __init__(self, accept: ReadingFilter | None = None) -> None:
        self._accept = accept
        self._queue: queue.Queue[Sample] = queue.Queue(READING_QUEUE_LIMIT)
        self._closed = threading.Event()
        self._undeclare: Callable[[], object] = lambda: None
        self.dropped = 0
        """Number of samples dropped from the full queue."""
        self.unreadable = 0
        """Number of samples that are not messages of this schema."""

    def begin(self, subscribe: Callable[[Callable[[Sample], None]], Callable[[], object]]) -> Self:
        """Subscribe. `subscribe` returns the function that ends the subscription."""
        self._undeclare = subscribe(self._on_sample)
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Reading:
        if (reading := self.within(inf)) is None:
            raise StopIteration
        return reading

    def within(self, seconds: float) -> Reading | None:
        """Return the next reading, or None if none arrives within this time, or if the stream is closed."""
        deadline = time.monotonic() + seconds
        while not self._closed.is_set():
            left_s = deadline - time.monotonic()
            try:
                reading = reading_of(self._queue.get(timeout=max(0.0, min(left_s, _CLOSE_POLL_S))))
            except queue.Empty:
                if left_s > _CLOSE_POLL_S:
                    continue
                return None
            except (messages.BadPayload, KeyError):
                self.unreadable += 1
                continue
            if self._accept is None or self._accept(reading):
                return reading
        return None

    def close(self) -> None:
        """End the stream and its iteration."""
        if not self._closed.is_set():
            self._closed.set()
            self._undeclare()

    def _on_sample(self, sample: Sample) -> None:
        """Queue a sample.

        Only the Zenoh thread of the subscription calls this. So nothing else fills the queue between the check and the
        put.
        """
        if self._queue.full():
            with contextlib.suppress(queue.Empty):  # the reader has just emptied the queue
                self._queue.get_nowait()
                self.dropped += 1
        self._queue.put_nowait(sample)
