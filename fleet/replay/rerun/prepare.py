"""Prepares the files of a session for Rerun's MCAP reader, which shows only a part of some files.

The reader picks one schema for each key at random, skips chunks without message indexes, refuses files without chunks,
shows chunks that fail their checksum, and aborts the process on an enum number without a name. And it is slow if there
are few messages of each key in a chunk. If a session has any of these, its messages are copied first: those of the
first schema of each key into one file, those of the second into another, and so on.
"""

from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from fleet.recording.left_out import LeftOut, LeftOutCause, has_unknown_enum, may_have_enum
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_index import Index
from fleet.recording.reading.mcap_reader import ChannelInfo, Row
from fleet.recording.reading.message_decoder import SAME_SCHEMA, MessageDecoder, compare_schema
from fleet.recording.reading.session import Session
from fleet.recording.selection import Selection

Wanted = Callable[[str], bool]
MIN_RUN: Final = 8
"""Minimum mean number of messages of one key in one chunk, for a file that is not copied. Rerun makes a chunk of its
own of each such run, and a chunk of one message takes as long as one of hundreds (some 0.4 ms). The recorder ends a
chunk each second, so its runs have one or two messages. Five minutes of five cars took 20 s and 73 MB, and with a copy
3 s and 10 MB."""
MIN_RUNS: Final = 500
"""Minimum number of runs for which a copy pays."""
COPY_CHUNK_NS: Final = 60_000_000_000
"""Maximum time span of a chunk in the copies. The MCAP writer also ends a chunk at 1 MiB."""
MAX_VARIANTS: Final = 16
"""Maximum number of copies. If a key has more schemas than this, the remaining ones share the last copy."""


class Prepared(Struct):
    """The files to give to Rerun, and the number of messages that were recorded."""

    files: list[Path]
    recorded: Counter[str] = field(default_factory=Counter)
    """Number of messages by key. It includes the messages of `left_out`, which are not in the files."""
    left_out: LeftOut = field(default_factory=LeftOut)


def as_recorded(session: Session, selection: Selection, wanted: Wanted, *, whole: bool) -> Prepared | None:
    """Return the session's own files if Rerun can read them as they are, else None. wanted: see `copied`.

    whole: True if the selection is the whole session.
    """
    indexes = list(session.indexes().values())
    if session.damage or len(indexes) != len(session.segments):
        return None
    if _is_scattered(indexes):
        return None
    decoder = MessageDecoder()
    enums: set[str] = set()
    for index in indexes:
        if index is None or not _is_plain(index):
            return None
        for channel in index.channels.values():
            info = ChannelInfo(channel, index.schemas.get(channel.schema_id))
            if _refusal(decoder, info) is not None:
                return None
            if _may_abort(decoder, info):
                enums.add(channel.topic)
    if enums and any(_aborts(decoder, row) for row in session.rows(Selection(tuple(enums)))):
        return None
    prepared = Prepared(list(session.segments))
    if whole:
        prepared.recorded.update(_total(indexes))
    else:
        prepared.recorded.update(
            row[0].channel.topic for row in session.rows(selection) if wanted(row[0].channel.topic)
        )
    return prepared


def copied(
    session: Session, selection: Selection, wanted: Wanted, scratch: Path, refused: Collection[str] = ()
) -> Prepared:
    """Copy the messages into files that Rerun reads completely. Raises OSError if they cannot be written.

    wanted: returns True for a key to copy. scratch: an existing directory. refused: names of schemas of
    which Rerun refuses those that are not ours.
    """
    prepared = Prepared([])
    decoder = MessageDecoder()
    variants: dict[str, list[tuple[str, str, bytes]]] = {}
    copies: list[McapCopy] = []
    known: dict[int, tuple[ChannelInfo, int, bool, LeftOutCause | None]] = {}
    with ExitStack() as stack:
        for row in session.rows(selection):
            info = row[0]
            key = info.channel.topic
            if not wanted(key):
                continue
            prepared.recorded[key] += 1
            entry = known.get(id(info))
            if entry is None:
                schemas = variants.setdefault(key, [])
                schema = _schema_of(info)
                if schema not in schemas:
                    schemas.append(schema)
                number = min(schemas.index(schema), MAX_VARIANTS - 1)
                entry = known[id(info)] = (info, number, _may_abort(decoder, info), _refusal(decoder, info, refused))
            _, number, checked, cause = entry
            if cause is None and checked and _aborts(decoder, row):
                cause = LeftOutCause.UNKNOWN_ENUM
            if cause is not None:
                prepared.left_out.add(key, cause)
                continue
            while len(copies) <= number:
                path = scratch / f"{len(copies) + 1:04d}.mcap"
                copies.append(stack.enter_context(McapCopy(path, chunk_ns=COPY_CHUNK_NS)))
                prepared.files.append(path)
            copies[number].add(row)
    return prepared


def unreadable(session: Session, selection: Selection, wanted: Wanted) -> Counter[str]:
    """Return the number of messages that do not match their schema, for each of the wanted keys."""
    decoder = MessageDecoder()
    found: Counter[str] = Counter()
    for row in session.rows(selection):
        key = row[0].channel.topic
        if wanted(key) and decoder.class_of(row[0]) is not None and decoder.message(row[0], row[4]) is None:
            found[key] += 1
    return found


def _is_scattered(indexes: list[Index | None]) -> bool:
    """Return True if the chunks of these files have so few messages of each key that a copy pays."""
    runs = sum(chunk.channel_count for index in indexes if index is not None for chunk in index.chunks)
    return runs >= MIN_RUNS and _total(indexes).total() < MIN_RUN * runs


def _is_plain(index: Index) -> bool:
    """Return True if Rerun reads every message of a file with this index."""
    if not (index.has_all_chunks and index.has_all_channels and all(chunk.table for chunk in index.chunks)):
        return False
    schemas: dict[str, tuple[str, str, bytes]] = {}
    for channel in index.channels.values():
        schema = _schema_of(ChannelInfo(channel, index.schemas.get(channel.schema_id)))
        if schemas.setdefault(channel.topic, schema) != schema:
            return False
    return True


def _schema_of(info: ChannelInfo) -> tuple[str, str, bytes]:
    """Return the properties of a channel by which Rerun decides how to read it."""
    schema = info.schema
    return (info.channel.message_encoding, "", b"") if schema is None else (schema.encoding, schema.name, schema.data)


def _refusal(decoder: MessageDecoder, info: ChannelInfo, refused: Collection[str] = ()) -> LeftOutCause | None:
    """Return why a channel must not reach Rerun, or None.

    One bad schema would make Rerun's reader fail for all keys.
    """
    if info.schema is not None and info.schema.encoding == "protobuf":
        if info.channel.message_encoding != "protobuf":
            return LeftOutCause.NOT_PROTOBUF
        message_class = decoder.class_of(info)
        if message_class is None:
            return LeftOutCause.BAD_SCHEMA
        # Another schema of this name in the session may be ours, which Rerun reads.
        if info.schema.name in refused and compare_schema(message_class) != SAME_SCHEMA:
            return LeftOutCause.BAD_SCHEMA
    return None


def _may_abort(decoder: MessageDecoder, info: ChannelInfo) -> bool:
    message_class = decoder.class_of(info)
    return message_class is not None and may_have_enum(message_class.DESCRIPTOR)


def _aborts(decoder: MessageDecoder, row: Row) -> bool:
    message: Any = decoder.message(row[0], row[4])
    return message is not None and has_unknown_enum(message)


def _total(indexes: list[Index | None]) -> Counter[str]:
    total: Counter[str] = Counter()
    for index in indexes:
        total.update(index.counts if index is not None else {})
    return total
