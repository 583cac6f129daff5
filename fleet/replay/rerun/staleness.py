"""Where lanes end: a state that nobody says any more is not shown as if it still were so.

A topic is stale after the time that its table tells; one gap or more in what was heard of it become ends of its lanes.
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

PUBLISHED: Final = "message_publish_time"
"""When a message was published, by its publisher's clock."""
LOGGED: Final = "message_log_time"
"""When it came, by the recorder's own clock."""


class _Run(NamedTuple):
    """A time in which a topic was never stale, ns since the epoch."""

    first: int
    last: int
    last_logged: int


class StaleStates:
    """What was heard when, of every entity that has lanes."""

    def __init__(self) -> None:
        self._runs: dict[str, list[_Run]] = {}
        self._topics: dict[str, str] = {}
        self._told: dict[str, int] = {}
        """Last message before an end that was drawn already."""

    def heard(self, path: str, topic: str, batch: Any) -> None:
        """Messages of an entity, in any order."""
        if topic not in _LANES:
            return
        published, logged = (_ns(batch.column(name)) for name in (PUBLISHED, LOGGED))
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
        """The ends that were not drawn yet; `now_ns`: when the newest message of all was published."""
        for path, runs in self._runs.items():
            topic = self._topics[path]
            stale_ns = _stale_ns(topic)
            before: _Run | None = None
            ends: list[_Run] = []
            for run in sorted(runs):
                if before is None or run.first - before.last > stale_ns:
                    ends += [before] if before is not None else []
                    before = run
                elif run.last > before.last:
                    before = run
            assert before is not None
            self._runs[path] = [before]
            ends += [before] if now_ns - before.last > stale_ns else []
            ends = [end for end in ends if end.last > self._told.get(path, 0)]
            if ends:
                self._told[path] = ends[-1].last
                yield _nothing(path, topic, ends)


def _nothing(path: str, topic: str, ends: list[_Run]) -> Any:
    indexes = [
        rr.TimeColumn(name, timestamp=np.array(at, dtype="datetime64[ns]") + np.timedelta64(_stale_ns(topic), "ns"))
        for name, at in ((PUBLISHED, [end.last for end in ends]), (LOGGED, [end.last_logged for end in ends]))
    ]
    columns = rr.AnyValues.columns(**{name: pa.nulls(len(ends), kind) for name, kind in _LANES[topic].items()})
    return rrc.Chunk.from_columns(path, indexes=indexes, columns=columns)


def _ns(times: Any) -> Any:
    return times.cast(pa.int64()).to_numpy(zero_copy_only=False)


def _stale_ns(topic: str) -> int:
    return int((TOPICS[topic].stale_after_s or 0.0) * 1e9)


def _lanes() -> dict[str, dict[str, Any]]:
    """Topic: its lanes, with what their states are; of topics that can be stale."""
    found: dict[str, dict[str, Any]] = {}
    for part in panels.parts():
        if isinstance(part, StateTrack) and not part.drawn and TOPICS[part.topic].stale_after_s is not None:
            fields = message_class(TOPICS[part.topic].message).DESCRIPTOR.fields_by_name
            is_bool = part.how is None and fields[part.field].type == FieldDescriptor.TYPE_BOOL
            found.setdefault(part.topic, {})[part.name] = pa.bool_() if is_bool else pa.string()
    return found


_LANES: Final[Mapping[str, Mapping[str, Any]]] = _lanes()
