"""One MCAP file being written: channels, schemas, what was missed in each. No threads, no bus session here."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import zenoh
from mcap.writer import LIBRARY_IDENTIFIER, Writer

from schemas import messages

SENDERS_PER_KEY: Final = 16
"""Whose numbers are remembered per key: every `fleet drive` is a sender of its own."""
_WRAP: Final = 1 << 32  # numbers travel modulo 2^32
_BACKWARDS: Final = 1 << 31


class _Channel:
    """A channel, and the last number of each of its publishers."""

    __slots__ = ("encoding", "id", "last")

    def __init__(self, channel_id: int, encoding: zenoh.Encoding) -> None:
        self.id = channel_id
        self.encoding = encoding
        self.last: dict[tuple[zenoh.ZenohId, int], int] = {}


class Segment:
    """Writes what came from the bus; every method may raise OSError, after which only `abandon` makes sense."""

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self._file = path.open("xb")
        # Half of its methods have no types. Its own checksums leave out what lies between chunks.
        self._writer: Any = Writer(self._file, enable_data_crcs=True)
        self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
        self._writer.add_metadata("session", dict(about))
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._others: dict[tuple[str, str], _Channel] = {}
        self.path = path
        self.messages = 0
        self.missed: dict[str, int] = {}
        """By key: gaps in the publishers' numbers."""
        self.flush()

    def add(
        self,
        key: str,
        payload: bytes,
        encoding: zenoh.Encoding,
        stamp: zenoh.Timestamp | None,
        source: zenoh.SourceInfo | None,
        received_ns: int,
    ) -> None:
        """Write one publication as it came. This is the path of every message: each call in it costs."""
        channel = self._channels.get(key)
        if channel is None or channel.encoding != encoding:
            channel = self._channel(key, encoding)
        sequence = 0
        if source is not None:
            sequence = source.source_sn
            entity = source.source_id
            sender = (entity.zid, entity.eid)  # an EntityGlobalId itself compares by identity
            last = channel.last.get(sender)
            if last is None:
                self._remember(channel)
            elif sequence != last + 1:
                self._count_gap(key, last, sequence)
            channel.last[sender] = sequence
        published_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else received_ns
        self._writer.add_message(channel.id, received_ns, payload, published_ns, sequence)
        self.messages += 1

    def _channel(self, key: str, encoding: zenoh.Encoding) -> _Channel:
        """The channel of a key and an encoding; a key has another one only if its encoding changes."""
        words = str(encoding)
        channel = self._others.get((key, words))
        if channel is None:
            kind, schema_id = self._schema(words)
            channel_id = self._writer.register_channel(key, kind, schema_id, {"zenoh_encoding": words})
            channel = self._others[key, words] = _Channel(channel_id, encoding)
        self._channels[key] = channel
        return channel

    def _schema(self, encoding: str) -> tuple[str, int]:
        """(MCAP message encoding, schema id) of a Zenoh encoding; what we know no schema of has id 0."""
        name = messages.name_in(encoding)
        if name is None:
            return ("json" if encoding.partition(";")[0] == messages.JSON else encoding), 0
        if name not in self._schemas:
            try:
                descriptors = messages.descriptor_set(name)
            except KeyError:
                return encoding, 0
            self._schemas[name] = self._writer.register_schema(name, "protobuf", descriptors)
        return "protobuf", self._schemas[name]

    @staticmethod
    def _remember(channel: _Channel) -> None:
        """Make room for one more sender; its first number says nothing about what was missed."""
        if len(channel.last) >= SENDERS_PER_KEY:
            del channel.last[next(iter(channel.last))]

    def _count_gap(self, key: str, last: int, sequence: int) -> None:
        gap = (sequence - last - 1) % _WRAP
        # A number that goes back is a new stream of the same sender, not a gap of four thousand million.
        if 0 < gap < _BACKWARDS:
            self.missed[key] = self.missed.get(key, 0) + gap

    def flush(self) -> None:
        """End the chunk and give everything to the operating system: what is flushed survives our crash."""
        self._writer.flush()

    def finish(self, drops: Mapping[str, int]) -> None:
        """Write what was lost and the index, and close the file."""
        lost = {"drops": json.dumps(dict(drops)), "missed": json.dumps(self.missed)}
        self._writer.flush()
        self._writer.add_metadata("recording", {"messages": str(self.messages), **lost})
        self._writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close a file that cannot be written any more; what was flushed stays as it is."""
        try:
            self._file.close()
        except OSError:
            # The rest of the buffer has nowhere to go, which is why we are here; release the descriptor all the same.
            self._file.raw.close()
