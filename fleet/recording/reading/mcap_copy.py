"""Copies messages of a session into a new MCAP file, unchanged, with their channels and schemas."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from mcap.records import Attachment
from mcap.writer import LIBRARY_IDENTIFIER, Writer

from fleet.recording.reading.mcap_reader import ChannelInfo, Extra, Row

SESSION_METADATA: Final = "session"
"""Name of the metadata record that says to which session a file belongs."""
CHUNK_NS: Final = 1_000_000_000
"""Usual maximum time span of a chunk, as in the recorder's files. So reading a short part decompresses little more than
that part."""


class McapCopy:
    """One file to write. Every method may raise OSError. After an exception, the file stays without its end."""

    def __init__(self, path: Path, about: Mapping[str, str] | None = None, chunk_ns: int = CHUNK_NS) -> None:
        self._span_ns = chunk_ns
        """Maximum time span of a chunk."""
        self._file = path.open("xb")
        self._writer: Any = Writer(self._file, enable_data_crcs=True)
        self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
        if about:
            self._writer.add_metadata(SESSION_METADATA, dict(about))
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._channel_ids: dict[int, tuple[ChannelInfo, int]] = {}
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
            with suppress(OSError):  # the disk has failed, as `error` says
                self._file.close()

    def add(self, row: Row) -> None:
        """Write one message unchanged."""
        info, sequence, log_ns, publish_ns, data = row
        # A ChannelInfo is looked up by its Python id, which is fast. It is stored, too, so that no other object gets
        # this id.
        entry = self._channel_ids.get(id(info))
        if entry is None:
            entry = self._channel_ids[id(info)] = (info, self._channel(info))
        if self._chunk_ns is None or not 0 <= log_ns - self._chunk_ns < self._span_ns:
            if self._chunk_ns is not None:
                self._writer.flush()
            self._chunk_ns = log_ns
        self._writer.add_message(entry[1], log_ns, data, publish_ns, sequence)
        self.messages += 1

    def add_extras(self, extras: Iterable[Extra]) -> None:
        """Write attachments and metadata records unchanged."""
        for extra in extras:
            if isinstance(extra, Attachment):
                self._writer.add_attachment(extra.create_time, extra.log_time, extra.name, extra.media_type, extra.data)
            else:
                self._writer.add_metadata(extra.name, extra.metadata)

    def _channel(self, info: ChannelInfo) -> int:
        channel, schema = info
        schema_id = 0
        if schema is not None:
            key = (schema.name, schema.encoding, schema.data)
            if key not in self._schemas:
                self._schemas[key] = self._writer.register_schema(*key)
            schema_id = self._schemas[key]
        properties = (channel.topic, channel.message_encoding, schema_id, tuple(channel.metadata.items()))
        if properties not in self._channels:
            self._channels[properties] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        return self._channels[properties]
