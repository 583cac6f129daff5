"""Reads a session: its segments, its description and every intact message. Repairs nothing.

A session is a directory (session_dir.py) or a single .mcap file of any writer. mcap_reader.py reads the files.
"""

import errno
import os
import re
from collections.abc import Iterable, Iterator
from copy import copy
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, overload

from mcap.records import Metadata
from msgspec import Struct

from fleet.client.reading import Reading
from fleet.recording import session_dir
from fleet.recording.left_out import LeftOut
from fleet.recording.reading.mcap_copy import SESSION_METADATA, McapCopy
from fleet.recording.reading.mcap_index import Index
from fleet.recording.reading.mcap_reader import Extra, McapReader, NotMcap, Row
from fleet.recording.reading.message_decoder import MessageDecoder, message_of, why_not_decoded
from fleet.recording.selection import EVERYTHING, Selection, key_expressions
from fleet.recording.session_lookup import NoLatest, find_session, sessions_place
from fleet.recording.tools.analysis import (
    NoTable,
    add_modes,
    arrow_table,
    data_frame,
    is_known,
    join_as_of,
    mode_rows,
    no_messages,
    spans_table,
    stray_tables,
    warn_of_modes,
)
from fleet.recording.tools.mode_spans import MODE_TOPIC, ModeSpan, sensor_of, spans_without
from schemas.keys import DEFAULT_FLEET
from schemas.suggestion import did_you_mean

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs


LATEST: Final = "latest"


class NoSession(Exception):
    """There is no such session, or nothing in it can be used. The message gives the reason."""


def _near(path: Path) -> str:
    """Return a question that proposes a likely session, with a blank at its end. Empty if no name is near."""
    place = sessions_place()
    there = sorted(each.name for each in place.iterdir() if each.is_dir()) if place.is_dir() else []
    near = did_you_mean(path.name, [LATEST, *there])
    return near and f"{near} "


class Recorded(Struct, frozen=True):
    """One message of a session, with its payload as on the bus."""

    key: str
    payload: bytes
    message: str
    """Full protobuf name, or an empty text if the file has no schema for it."""
    encoding: str
    """MCAP message encoding: `protobuf`, `json`, or the encoding of the publisher."""
    published_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch."""
    recorded_ns: int
    """Time of the recorder's clock, ns since the epoch."""
    sequence: int
    """Sequence number of the publisher for the key, modulo 2^32. 0 if the publisher sent none."""


class Session:
    """A recorded session: `Session("latest").to_pandas("sensor/range")`.

    `path` is the directory of a session, an .mcap file, the name of a session, or `latest` (`latest~1` is the one
    before). Names are looked up in `./sessions`, or in the directory that `record` names in the fleet file here.
    Raises NoSession. A session is never changed by reading it. `damage_words` describes the damage that was found.
    """

    def __init__(self, path: str | PathLike[str] = LATEST) -> None:
        try:
            path = find_session(path)
        except NoLatest as error:
            raise NoSession(str(error)) from None
        try:
            whole = path.is_dir()
            there = sorted(path.glob(session_dir.SEGMENTS)) if whole else [path]
            if whole and not there:
                # Glob hides a missing permission. Listing the directory raises it.
                next(path.iterdir(), None)
                raise NoSession(f"{path} is not a session: no {session_dir.segment(Path(), 1)} in it")
            if not whole:
                path.stat()  # since Python 3.14, `exists` hides a missing permission
        except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte
            raise NoSession(f"There is no session at {path}. {_near(path)}`fleet sessions` lists them.") from None
        except OSError as error:
            raise NoSession(f"{path} cannot be read: {error.strerror}") from None
        self.path = path
        self.damage: dict[Path, str] = {}
        """Damage that opening, checking or reading has found so far."""
        self.unended: set[Path] = set()
        """Segments that are only truncated, like a file that is still being written."""
        self.lost_extras = ""
        """Damage of attachments and metadata that the last call of `extras` has found, in words."""
        self.left_out = LeftOut()
        """Messages by key and cause that the last call of `messages(decode=True)` could not decode so far."""
        for segment in there:
            try:
                McapReader(segment)
            except NotMcap as error:
                self.damage[segment] = str(error)
        if len(self.damage) == len(there):
            raise NoSession("; ".join(f"{segment} {words}" for segment, words in self.damage.items()))
        self.segments = tuple(segment for segment in there if segment not in self.damage)
        """Readable segments, in order."""
        self.description = session_dir.SessionInfo.read(path) if whole else None
        if whole:
            numbered = {session_dir.segment(path, number + 1) for number in range(int(there[-1].stem))}
            # Only index.json can show that the last segment is missing.
            closed = {path / one["file"] for one in session_dir.indexed_segments(path)}
            if missing := sorted((numbered | closed) - set(there) - self._taken()):
                self.damage[path] = f"lacks {len(missing)} of its files, the first is {missing[0].name}"
            given = session_dir.read_json(path / session_dir.SESSION_FILE).get("format")
            if isinstance(given, int) and given > session_dir.FORMAT_VERSION:
                raise NoSession(
                    f"{path} has format {given}, this version reads up to {session_dir.FORMAT_VERSION}: "
                    "update zenoh-car-fleet; "
                    f"its files can be read one by one, such as {there[0].name} in it"
                )

    def __repr__(self) -> str:
        return f"Session({str(self.path)!r})"

    def _taken(self) -> set[Path]:
        """Return the segments that the quota has removed."""
        return (
            set()
            if self.description is None
            else {self.path / each["file"] for each in session_dir.gone_of(self.description)}
        )

    def part(self, segments: tuple[Path, ...]) -> "Session":
        """Return a session that has only these segments."""
        part = copy(self)
        part.segments, part.damage, part.unended, part.left_out = segments, {}, set(), LeftOut()
        return part

    @property
    def name(self) -> str:
        """Return the name of the directory, or of the file without its suffix."""
        return self.path.resolve().name if self.path.is_dir() else self.path.stem

    @property
    def undescribed(self) -> str:
        """Describe what is wrong with session.json of a directory. Empty if it can be read."""
        unread = self.description is None and self.path.is_dir()
        return "is missing or unreadable: it names recorder and marks" if unread else ""

    def lacking(self, messages: int) -> str:
        """Describe how many messages session.json counts beyond `messages`. Empty if none, or if not known."""
        info = self.description
        gone = session_dir.gone_messages(info) if info is not None else 0
        total = info.messages - gone if info is not None and info.closed and gone is not None else 0
        return f"says that there were {total} messages: {total - messages} are not here" if messages < total else ""

    @property
    def damage_words(self) -> str:
        """Return the damage on one line, or an empty text if there is none."""
        return "; ".join(f"{path} {words}" for path, words in sorted(self.damage.items()))

    def check(self) -> None:
        """Check CRCs, also those that reading skips, and add failures to `damage`.

        In a file with a damaged chunk, the CRCs of attachments and of the bytes between chunks are not checked.
        """
        for segment in self.segments:
            try:
                reader = McapReader(segment)
                reader.check()
            except NotMcap as error:  # the file was replaced since it was opened
                self.damage[segment] = str(error)
            else:
                self._add_damage(reader)

    def rescue(self, out: Path) -> "Session":
        """Copy every intact message, attachment and metadata record into a new file, and return it as a session.

        Raises OSError, also if the file exists, and NoSession if no message is intact. The returned session reads the
        new file, but keeps the name, the path and the description of this one.

        Use it for truncated or damaged files: other readers stop at the damage, or show corrupted messages.
        """
        if out.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(out))
        part = out.with_name(f".{out.name}.part")
        try:
            with McapCopy(part) as copy:
                copy.add_extras(self.extras())
                for row in self.rows():
                    copy.add(row)
            if not copy.messages:
                raise NoSession(f"{self.path} has no intact message: {self.damage_words}")
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)
        return self.part((out,))

    def extras(self) -> list[Extra]:
        """Return the intact attachments and metadata records, each once. `lost_extras` then describes the damaged ones.

        The record that names the session, which each of our own files has, is left out.
        """
        found: list[Extra] = []
        self.lost_extras = ""
        for segment in self.segments:
            try:
                reader = McapReader(segment)
            except NotMcap:  # the file was removed since it was opened: reading its messages reports that
                continue
            for extra in reader.extras():
                own = isinstance(extra, Metadata) and extra.name == SESSION_METADATA and "format" in extra.metadata
                if not own and extra not in found:
                    found.append(extra)
            if reader.damage:
                words = f"{segment} {'; '.join(map(str, reader.damage))}"
                self.lost_extras = f"{self.lost_extras}; {words}" if self.lost_extras else words
        return found

    @overload
    def messages(
        self,
        keys: str | Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        decode: Literal[False] = False,
    ) -> Iterator[Recorded]: ...

    @overload
    def messages(
        self,
        keys: str | Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        decode: Literal[True],
    ) -> Iterator[Reading]: ...

    def messages(
        self,
        keys: str | Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        decode: bool = False,
    ) -> Iterator[Recorded] | Iterator[Reading]:
        """Yield every intact message in the order of the file. Afterwards, `damage_words` describes the damage.

        `keys` selects one or several topics (`sensor/range`, `sensor/*`), message types (`fleet.v1.Range`), keys or
        key expressions (`red/sensor/range`, `fleet/red/**`). `start_ns` (included) and `end_ns` (excluded) are times of
        the recorder's clock, ns since the epoch. If the files have an index, only the parts with these times are read.
        So reading the last minute of a long session takes hardly longer than reading a session of one minute. With
        `decode`, yield readings, as `Fleet.watch` does; messages that cannot be decoded are counted in `left_out`.
        Without it, yield payloads as they were on the bus. Raises NoTable if `keys` is one name without wildcards that
        is neither known nor in the session. That takes the indexes of all files. If a file has none, nothing is yielded
        instead.
        """
        selection = self.selection(keys, start_ns, end_ns)
        if isinstance(keys, str) and not is_known(keys) and self._lacks(selection):
            raise no_messages(keys, self.name)
        rows = self.rows(selection)
        return self._readings(rows) if decode else map(_recorded, rows)

    def _lacks(self, selection: Selection) -> bool:
        """Return True if the indexes of all segments show that no key is selected."""
        indexes = [index for index in self.indexes().values() if index is not None and index.has_all_channels]
        recorded = {channel.topic for index in indexes for channel in index.channels.values()}
        return len(indexes) == len(self.segments) and not any(map(selection.has_key, recorded))

    def _readings(self, rows: Iterable[Row]) -> Iterator[Reading]:
        decoder = MessageDecoder()
        self.left_out = LeftOut()
        for info, _, _, publish_ns, data in rows:
            value = decoder.message(info, data)
            if value is not None:
                yield Reading.of(info.channel.topic, value, publish_ns)
            else:
                self.left_out.add(info.channel.topic, why_not_decoded(decoder, info))

    def to_arrow(self, of: str, *, start_ns: int | None = None, end_ns: int | None = None) -> "pa.Table":
        """Return the messages of one type as a pyarrow.Table, one row for each message, in the order of publish_time.

        `of` is a topic (`sensor/range`), a message (`fleet.v1.Range`), or a key expression that matches one type of
        message (`red/sensor/range`). `start_ns` and `end_ns` are as for `messages`.
        The columns are key, car, log_time (recorder's clock), publish_time (publisher's clock), sequence, and then the
        fields. The times have the type timestamp[ns, UTC]. The unit of a field is in the column's name and in the
        field's metadata (`unit`). A value that was not measured is null. For commands, each field of the request has a
        column (`request_motion`). Messages of another type under these keys are left out; a warning counts them, and
        `stray_tables` has them. Messages that do not match their schema are left out and counted, too, and no table has
        them. Times beyond the year 2262 are null, with a warning. Raises NoTable, and FormatMissing (an ImportError)
        without the extra `analysis`.
        """
        return arrow_table(self.rows(self.selection(of, start_ns, end_ns)), of, self.name)

    def stray_tables(self, *, start_ns: int | None = None, end_ns: int | None = None) -> "dict[str, pa.Table]":
        """Return the messages whose type does not fit their key, one pyarrow.Table for each type.

        The names are such as `stray.fleet.v1.Range`, and `other` for messages that are not protobuf. `start_ns` and
        `end_ns` are as for `messages`. Raises FormatMissing without the extra `analysis`.
        """
        return stray_tables(self.rows(Selection(None, start_ns, end_ns)))

    def to_pandas(self, of: str, *, start_ns: int | None = None, end_ns: int | None = None) -> "pd.DataFrame":
        """Return the table of `to_arrow` as a pandas.DataFrame, with pd.NA for values that were not measured.

        `frame.attrs["units"]` has the units by column.
        """
        return data_frame(self.to_arrow(of, start_ns=start_ns, end_ns=end_ns))

    def joined(self, of: str, *others: str, tolerance_s: float | None = None) -> "pd.DataFrame":
        """Return the table of `of`. Each row also has what the same car had last published in `others` by then.

        `session.joined("sensor/range", "state/mode")` adds the columns `mode.asked`, `mode.verdict`, ... to those of
        `sensor/range`. The added columns are null in rows for which there is no value, or only one that is too old.
        `tolerance_s` is the maximum age, s, by publish_time. The default is the time after which the other topic is
        stale (3 s for readings and states); topics that are never stale have no limit. With `state/mode` there are two
        more columns: `mode` is the commanded mode, and `mode_seen` the mode that the car's readings show. They are null
        if not known. A warning says how long cars were in modes in which this reading does not exist: see
        `times_without`. Raises the errors of `to_pandas`, and ValueError for a negative `tolerance_s`.
        """
        if tolerance_s is not None and not tolerance_s >= 0:
            raise ValueError(f"tolerance_s {tolerance_s:g} is not allowed: at least 0, or None for the topic's own")
        table = self.to_arrow(of)
        for other in others:
            prefix = re.split(r"[/.]", other)[-1].lower()
            right = self.to_arrow(other)
            table = add_modes(join_as_of(table, right, prefix, tolerance_s))
            warn_of_modes(sensor_of(of), self._spans_without(of, right))
        return data_frame(table)

    def times_without(self, of: str) -> "pd.DataFrame":
        """Return when cars were in modes in which a reading does not exist: car, mode, begin and end of each time.

        For example, a car sends no distances in obstacle avoidance. If a plot marks these times, it shows why there are
        no points. `of` is as for `to_pandas`, but about one sensor (`sensor/range`, `red/sensor/range`). The mode is
        the commanded one or, if the car's readings contradict it, the one that they show. Manual mode has all readings.
        Raises NoTable for another name, and FormatMissing without the extra `analysis`.
        """
        if not sensor_of(of):
            raise NoTable(f"{of} does not name one sensor, such as sensor/range.")
        return data_frame(spans_table(self._spans_without(of, self.to_arrow(MODE_TOPIC.name))))

    def _spans_without(self, of: str, modes: "pa.Table") -> list[ModeSpan]:
        """Return the times without this reading of the cars that `of` names. `modes` is a table of `state/mode`."""
        sensor, named = sensor_of(of), self.selection(of)
        if not sensor:
            return []
        fleet = self.description.fleet if self.description is not None else DEFAULT_FLEET
        spans = spans_without(sensor, mode_rows(modes))
        return [span for span in spans if named.has_key(f"{fleet}/{span.car}/sensor/{sensor}")]

    def selection(
        self, keys: str | Iterable[str] | None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Selection:
        """Return the selection of messages by names as in `messages` and by time."""
        if keys is None:
            return Selection(None, start_ns, end_ns)
        fleet = self.description.fleet if self.description is not None else DEFAULT_FLEET
        names = [keys] if isinstance(keys, str) else keys
        return Selection(tuple(each for name in names for each in key_expressions(name, fleet)), start_ns, end_ns)

    def rows(self, selection: Selection = EVERYTHING) -> Iterator[Row]:
        """Yield messages as plain tuples with their channel and schema.

        This takes less time than `messages`, and a third of the time of `messages(decode=True)`.
        """
        for segment in self.segments:
            yield from self._read_segment(segment, selection)

    def expected(self) -> dict[Path, int | None]:
        """Return the expected messages of each segment, from its index or index.json, or None if unknown."""
        counts = ((each["file"], each.get("messages")) for each in session_dir.indexed_segments(self.path))
        indexed = {name: count for name, count in counts if isinstance(count, int)}
        found: dict[Path, int | None] = {}
        for segment, index in self.indexes().items():
            statistics = None if index is None else index.statistics
            found[segment] = indexed.get(segment.name) if statistics is None else statistics.message_count
        gone = (path for path in self.damage if path.suffix == ".mcap" and path not in found)
        return found | {path: indexed.get(path.name) for path in gone}

    def indexes(self) -> dict[Path, Index | None]:
        """Return the index of each segment, or None if it is damaged, not complete, or cannot be read."""
        found: dict[Path, Index | None] = {}
        for segment in self.segments:
            try:
                found[segment] = McapReader(segment).index()
            except (NotMcap, OSError):
                found[segment] = None
        return found

    def _read_segment(self, segment: Path, selection: Selection) -> Iterator[Row]:
        try:
            reader = McapReader(segment)
        except NotMcap as error:
            self.damage[segment] = str(error)
            return
        yield from reader.messages(selection)
        self._add_damage(reader)

    def _add_damage(self, reader: McapReader) -> None:
        if reader.damage:
            self.damage[reader.path] = reader.words
            if reader.only_cut:
                self.unended.add(reader.path)
            else:
                self.unended.discard(reader.path)


def _recorded(row: Row) -> Recorded:
    info, sequence, log_ns, publish_ns, data = row
    return Recorded(
        info.channel.topic, data, message_of(info), info.channel.message_encoding, publish_ns, log_ns, sequence
    )
