"""One MCAP file being written: channels, schemas, messages. What goes into which file is tape.py's. No threads here."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mcap.writer import LIBRARY_IDENTIFIER, Writer

from schemas import messages

_HEAD: Final = "session"
_END: Final = "recording"


class Segment:
    """Every method may raise OSError, after which only `cut` makes sense."""

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self._file = path.open("xb")
        # Half of its methods have no types. Its own checksums leave out what lies between chunks.
        self._writer: Any = Writer(self._file, enable_data_crcs=True)
        self._schemas: dict[str, int] = {}
        self.path = path
        self.bytes = 0
        """What is certain to be in the file."""
        self.add = self._writer.add_message
        """(channel, log time, payload, publish time, sequence): the path of every message, where each call costs."""
        try:
            self._writer.start(library=f"zenoh-car-fleet; {LIBRARY_IDENTIFIER}")
            self._writer.add_metadata(_HEAD, dict(about))
            self.flush()
        except OSError:
            self.cut()
            raise

    def channel(self, key: str, encoding: str) -> int:
        """A new channel for a key and a Zenoh encoding."""
        kind, schema = self._schema(encoding)
        channel: int = self._writer.register_channel(key, kind, schema, {"zenoh_encoding": encoding})
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

    def flush(self, *, sync: bool = False) -> None:
        """End the chunk and give everything to the operating system, which outlives us; `sync`: and to the disk."""
        self._writer.flush()
        self._file.flush()
        self.bytes = self._file.tell()
        if sync:
            os.fsync(self._file.fileno())

    def finish(self, lost: Mapping[str, object], *, sync: bool = False) -> None:
        """Write what was lost and the index, and close the file."""
        self._writer.flush()
        self._writer.add_metadata(_END, {name: json.dumps(value) for name, value in lost.items()})
        self._writer.finish()
        self._file.flush()
        if sync:
            os.fsync(self._file.fileno())
        self.bytes = self._file.tell()
        self._file.close()

    def cut(self) -> None:
        """Close a file that cannot be written any more, with what was flushed: half a chunk tells nobody anything."""
        with contextlib.suppress(OSError):
            os.truncate(self.path, self.bytes)
        try:
            self._file.close()
        except OSError:
            # The rest of the buffer has nowhere to go, which is why we are here; release the descriptor all the same.
            with contextlib.suppress(OSError):
                self._file.raw.close()
        with contextlib.suppress(OSError):  # closing may have written some of it all the same
            os.truncate(self.path, self.bytes)
