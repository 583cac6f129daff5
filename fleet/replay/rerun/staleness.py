"""Ends state tracks whose topic became stale, so that the viewer does not extend the last state forever.

A topic is stale if no message came for the time in schemas/topics.py. At each gap that is longer, its tracks end.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import rerun as rr
import rerun.chunk as rrc
from google.protobuf.descriptor import FieldDescriptor

from fleet.replay import panels
from fleet.replay.panels import StateTrack
from schemas.messages import message_class
from schemas.topics import TOPICS

PUBLISH_TIMELINE: Final = "message_publish_time"
"""Timeline of the publisher's clock."""
LOG_TIMELINE: Final = "message_log_time"
"""Timeline of the recorder's clock."""


class _Run(NamedTuple):
    """Time span in which a topic was never stale, ns since the epoch."""

    first: int
    last: int
    last_logged: int


class StaleStates:
    """The message times of each entity that has state tracks."""

    def __init__(self) -> None:
        self._runs: dict[str, list[_Run]] = {}
        self._topics: dict[str, str] = {}
        self._ended_ns: dict[str, int] = {}
        """By entity, the time of the last message before the latest end that was drawn."""

    def add(self, path: str, topic: str, batch: Any) -> None:
        """Add the times of messages of an entity, in any order."""
        if topic not in _TRACKS:
            return
        published, logged = (_ns(batch.column(name)) for name in (PUBLISH_TIMELINE, LOG_TIMELINE))
        order = np.argsort(published, kind="stable")
        published, logged = published[order], logged[order]
        gaps = np.flatnonzero(np.diff(published) > _stale_ns(topic))
        firsts, lasts = [0, *(gaps + 1)], [*gaps, len(published) - 1]
        self._topics[path] = topic
        self._runs.setdefault(path, []).extend(
            _Run(int(published[first]), int(published[last]), int(logged[last]))
            for first, last in zip(firsts, lasts, strict=True)
        )

    def chunks(self, now_ns: int) -> Iterator[Any]:
        """Yield the ends that were not drawn yet. `now_ns` is the publish time of the newest message of the session."""
        for path, runs in self._runs.items():
            topic = self._topics[path]
            stale_ns = _stale_ns(topic)
            before: _Run | None = None
            ends: list[_Run] = []
            for run in sorted(runs):
                if before is None:
                    before = run
                elif run.first - before.last > stale_ns:
                    ends.append(before)
                    before = run
                elif run.last > before.last:
                    before = run
            assert before is not None
            self._runs[path] = [before]
            if now_ns - before.last > stale_ns:
                ends.append(before)
            ends = [end for end in ends if end.last > self._ended_ns.get(path, 0)]
            if ends:
                self._ended_ns[path] = ends[-1].last
                yield _end_chunk(path, topic, ends)


def _end_chunk(path: str, topic: str, ends: list[_Run]) -> Any:
    indexes = [
        rr.TimeColumn(name, timestamp=np.array(at, dtype="datetime64[ns]") + np.timedelta64(_stale_ns(topic), "ns"))
        for name, at in (
            (PUBLISH_TIMELINE, [end.last for end in ends]),
            (LOG_TIMELINE, [end.last_logged for end in ends]),
        )
    ]
    columns = rr.AnyValues.columns(**{name: pa.nulls(len(ends), kind) for name, kind in _TRACKS[topic].items()})
    return rrc.Chunk.from_columns(path, indexes=indexes, columns=columns)


def _ns(times: Any) -> Any:
    return times.cast(pa.int64()).to_numpy(zero_copy_only=False)


def _stale_ns(topic: str) -> int:
    return int((TOPICS[topic].stale_after_s or 0.0) * 1e9)


def _tracks() -> dict[str, dict[str, Any]]:
    """Return the tracks and the types of their states, for each topic that can be stale."""
    found: dict[str, dict[str, Any]] = {}
    for part in panels.parts():
        if isinstance(part, StateTrack) and not part.drawn and TOPICS[part.topic].stale_after_s is not None:
            fields = message_class(TOPICS[part.topic].message).DESCRIPTOR.fields_by_name
            is_bool = part.derivation is None and fields[part.field].type == FieldDescriptor.TYPE_BOOL
            found.setdefault(part.topic, {})[part.name] = pa.bool_() if is_bool else pa.string()
    return found


_TRACKS: Final[Mapping[str, Mapping[str, Any]]] = _tracks()
