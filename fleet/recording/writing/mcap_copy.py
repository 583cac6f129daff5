"""Writing messages of a session into a new MCAP file, unchanged, with the channels and schemas they came with."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from mcap.writer import LIBRARY_IDENTIFIER, Writer

from fleet.recording.reading.mcap_reader import ChannelInfo, Row

CHUNK_NS: Final = 1_000_000_000
"""A chunk for each second, as the recorder's are: what is read of a part is no more than needed."""


class Copy:
    """One file; every method may raise OSError. Left by an exception, what was written stays, without an end."""

    def __init__(self, path: Path, about: Mapping[str, str] | None = None) -> None:
        self._file = path.open("xb")
        self._writer: Any = Writer(self._file, enable_data_crcs=True)
        self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
        if about:
            self._writer.add_metadata("session", dict(about))
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._lanes: dict[int, tuple[ChannelInfo, int]] = {}
        self._chunk_ns: int | None = None
        self.messages = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._writer.finish()
            self._file.close()
        else:
            with suppress(OSError):  # the disk that failed, which is why we are here
                self._file.close()

    def add(self, row: Row) -> None:
        """Write one message as it was."""
        lane, sequence, log_ns, publish_ns, data = row
        # By identity, which is quick; the lane is kept with it, so that no other can have the same.
        known = self._lanes.get(id(lane))
        if known is None:
            known = self._lanes[id(lane)] = (lane, self._channel(lane))
        if self._chunk_ns is None or not 0 <= log_ns - self._chunk_ns < CHUNK_NS:
            if self._chunk_ns is not None:
                self._writer.flush()
            self._chunk_ns = log_ns
        self._writer.add_message(known[1], log_ns, data, publish_ns, sequence)
        self.messages += 1

    def _channel(self, lane: ChannelInfo) -> int:
        channel, schema = lane
        schema_id = 0
        if schema is not None:
            kind = (schema.name, schema.encoding, schema.data)
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(*kind)
            schema_id = self._schemas[kind]
        where = (channel.topic, channel.message_encoding, schema_id, tuple(channel.metadata.items()))
        if where not in self._channels:
            self._channels[where] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        return self._channels[where]
