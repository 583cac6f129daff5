"""Writes one MCAP file: channels, schemas and messages. session_writer.py assigns messages to files. No threads.

The writer of the mcap package cannot be used after an error, because its index then has chunks that the file lacks. So
that writer writes into memory here, and only `flush` and `finish` write to the disk. If the disk is full, the data
stays in memory for the next try.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from io import FileIO
from pathlib import Path
from typing import Any, Final

from mcap.writer import LIBRARY_IDENTIFIER, Writer

from fleet.recording.reading.mcap_copy import SESSION_METADATA
from fleet.recording.session_dir import write_all
from schemas import messages

_LOSS_METADATA: Final = "recording"


class _Tail:
    """The end of a file that is not on the disk yet. It has the methods of a file that the mcap writer uses."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.start = 0
        """Position of the data in the file."""

    def write(self, data: bytes) -> int:
        self.data += data
        return len(data)

    def tell(self) -> int:
        return self.start + len(self.data)

    def flush(self) -> None:
        """Do nothing: `Segment.flush` writes to the disk."""

    def drop(self) -> None:
        """Forget data that is on the disk now."""
        self.start += len(self.data)
        self.data = bytearray()


class Segment:
    """One MCAP file to write.

    If `flush` or `finish` raises OSError, call it again when there is room, or call `cut`.
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self._file = FileIO(path, "xb")
        self._tail = _Tail()
        # Any: half of the writer's methods have no types. Data CRCs cover the bytes between chunks, too.
        self._writer: Any = Writer(self._tail, enable_data_crcs=True)  # type: ignore[arg-type]
        self._schemas: dict[str, int] = {}
        self._finished = False
        self.path = path
        self.add = self._writer.add_message
        """Adds (channel, log time, payload, publish time, sequence). A bound method: each call per message costs."""
        self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
        self._writer.add_metadata(SESSION_METADATA, dict(about))
        try:
            self.flush()
        except OSError:
            self.cut()
            raise

    @property
    def bytes(self) -> int:
        """Return the size on the disk, which is the size at the last flush."""
        return self._tail.start

    @property
    def is_there(self) -> bool:
        """Return False if somebody has moved or removed the file. All writes would succeed, and be lost."""
        return self.path.exists() and os.fstat(self._file.fileno()).st_nlink > 0

    @property
    def waiting_bytes(self) -> int:
        """Return the size of the data that is not on the disk yet."""
        return len(self._tail.data)

    def channel(self, key: str, encoding: str) -> int:
        """Register a channel for a key and a Zenoh encoding, and return its id."""
        kind, schema = self._schema(encoding)
        channel: int = self._writer.register_channel(key, kind, schema, {"zenoh_encoding": encoding})
        return channel

    def _schema(self, encoding: str) -> tuple[str, int]:
        """Return MCAP's message encoding and the schema id of a Zenoh encoding.

        The id is 0 if its schema is unknown.
        """
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
        """End the chunk, and pass all data to the operating system, or with `sync` to the disk."""
        if not self._finished:
            self._writer.flush()
        self._write(sync=sync)

    def finish(self, lost: Mapping[str, object], *, sync: bool = False) -> None:
        """Write the counts of lost messages and the index, and close the file."""
        if not self._finished:
            self._writer.flush()
            self._writer.add_metadata(_LOSS_METADATA, {name: json.dumps(value) for name, value in lost.items()})
            self._writer.finish()
            self._finished = True
        self._write(sync=sync)
        self._file.close()

    def cut(self) -> None:
        """Close the file without its end, because the disk has no room for it."""
        self._file.close()

    def _write(self, *, sync: bool) -> None:
        start = self._tail.start
        try:
            self._file.seek(start)
            write_all(self._file, bytes(self._tail.data))
            if sync:
                os.fsync(self._file.fileno())
        except OSError:
            with contextlib.suppress(OSError):  # half a chunk is useless and fills the disk
                self._file.truncate(start)
            raise
        self._tail.drop()
