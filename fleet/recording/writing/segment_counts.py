"""Counts the messages of each key in one segment for index.json, and the stops of the session."""

import contextlib
from collections.abc import Sequence
from typing import Any, Final

import zenoh
from google.protobuf.message import DecodeError

from fleet.recording.sequence_tracker import SequenceTracker
from fleet.recording.stop_count import EVENTS, StopCount
from schemas import messages

_EVENT_CLASS: Final = messages.message_class(EVENTS.message)


class KeyState:
    """Counters of one key and encoding in one segment."""

    __slots__ = ("channel", "count", "encoding", "final", "first", "has_events", "key", "tracker")

    def __init__(self, key: str, encoding: zenoh.Encoding, tracker: SequenceTracker, channel: int) -> None:
        self.key = key
        self.encoding = encoding
        self.tracker = tracker
        self.channel = channel
        self.count = self.first = self.final = 0
        self.has_events = messages.name_in(str(encoding)) == EVENTS.message
        """True for the events of commands, in which stops are counted."""


Row = tuple[KeyState, int, bytes, int, int]
"""State of the key, receive time, payload, publish time, sequence."""


class SegmentCounts:
    """The counters of one segment."""

    def __init__(self) -> None:
        self.states: dict[str, KeyState] = {}
        """The newest state of each key."""
        self._by_encoding: dict[tuple[str, str], KeyState] = {}
        self._first_ns = self._last_ns = 0

    @property
    def is_empty(self) -> bool:
        """True if no message was counted."""
        return not any(state.count for state in self._by_encoding.values())

    def find(self, key: str, encoding: zenoh.Encoding) -> KeyState | None:
        """Return the state of a key and an encoding, and make it the key's newest. None if there is none."""
        if (state := self._by_encoding.get((key, str(encoding)))) is not None:
            self.states[key] = state
        return state

    def add(self, state: KeyState) -> None:
        """Add the state of a new key, or of one whose encoding has changed."""
        self.states[state.key] = self._by_encoding[state.key, str(state.encoding)] = state

    def count(self, rows: Sequence[Row], stops: StopCount) -> None:
        """Count flushed messages, and the stops among them."""
        first_ns, last_ns = rows[0][1], rows[-1][1]
        if last_ns - first_ns < 0 or first_ns < self._last_ns:  # the clock was set back, so the rows are not in order
            first_ns, last_ns = min(row[1] for row in rows), max(row[1] for row in rows)
        self._first_ns = min(self._first_ns or first_ns, first_ns)
        self._last_ns = max(self._last_ns, last_ns)
        for state, _, payload, _, sequence in rows:
            if not state.count:
                state.first = sequence
            if state.has_events:
                with contextlib.suppress(DecodeError):  # any program can publish there
                    stops.add(_EVENT_CLASS.FromString(payload))
            state.count += 1
            state.final = sequence

    def entry(self, file: str, size: int) -> dict[str, Any]:
        """Return the entry of index.json."""
        counts: dict[str, dict[str, int]] = {}
        for state in self._by_encoding.values():
            if state.count:
                known = counts.setdefault(state.key, {"count": 0, "first": state.first, "last": 0})
                known["count"] += state.count
                known["last"] = state.final
        entry = {"file": file, "bytes": size, "keys": counts, "first_ns": self._first_ns, "last_ns": self._last_ns}
        return {**entry, "messages": sum(each["count"] for each in counts.values())}
