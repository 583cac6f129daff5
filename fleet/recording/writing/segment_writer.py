"""Writes one MCAP file: channels, schemas and messages. session_writer.py assigns messages to files. No threads."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mcap.writer import LIBRARY_IDENTIFIER, Writer

from fleet.recording.writing.mcap_copy import SESSION_METADATA
from schemas import messages

_LOSS_METADATA: Final = "recording"


class Segment:
    """One MCAP file to write. Every method may raise OSError; after an error only call `cut`."""

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self._file = path.open("xb")
        # Any: half of the writer's methods have no types. Data CRCs cover the bytes between chunks, too.
        self._writer: Any = Writer(self._file, enable_data_crcs=True)
        self._schemas: dict[str, int] = {}
        self.path = path
        self.bytes = 0
        """Flushed size of the file."""
        self.add = self._writer.add_message
        """Adds (channel, log time, payload, publish time, sequence). A bound method: each call per message costs."""
        try:
            self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
            self._writer.add_metadata(SESSION_METADATA, dict(about))
            self.flush()
        except OSError:
            self.cut()
            raise

    def channel(self, key: str, encoding: str) -> int:
        """Register a channel for a key and a Zenoh encoding, and return its id."""
        kind, schema = self._schema(encoding)
        channel: int = self._writer.register_channel(key, kind, schema, {"zenoh_encoding": encoding})
        return channel

    def _schema(self, encoding: str) -> tuple[str, int]:
        """Return (MCAP message encoding, schema id) of a Zenoh encoding; id 0 if its schema is unknown."""
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

    def flush(self, *, sync: bool = False) -> None:
        """End the chunk and pass all data to the operating system; with `sync`, to the disk."""
        self._writer.flush()
        self._file.flush()
        self.bytes = self._file.tell()
        if sync:
            os.fsync(self._file.fileno())

    def finish(self, lost: Mapping[str, object], *, sync: bool = False) -> None:
        """Write the counts of lost messages and the index, and close the file."""
        self._writer.flush()
        self._writer.add_metadata(_LOSS_METADATA, {name: json.dumps(value) for name, value in lost.items()})
        self._writer.finish()
        self._file.flush()
        if sync:
            os.fsync(self._file.fileno())
        self.bytes = self._file.tell()
        self._file.close()

    def cut(self) -> None:
        """Close a file after a write error, truncated to its last flush: half a chunk is of no use."""
        with contextlib.suppress(OSError):
            os.truncate(self.path, self.bytes)
        try:
            self._file.close()
        except OSError:
            # The rest of the buffer cannot be written. Release the descriptor all the same.
            with contextlib.suppress(OSError):
                self._file.raw.close()
        with contextlib.suppress(OSError):  # closing may have written part of the buffer
            os.truncate(self.path, self.bytes)
