"""Stores the tables of a session as Parquet beside it, for SQL questions about many sessions.

The tables for one state of a session are in the directory `.tables-<digest>`. The digest covers the sizes and times of
the segments, what the session's description says about the messages, and the columns of our tables. So a session that
grew gets a new directory, and the old one is deleted. A directory gets its name only when it is complete: if two
questions make it at the same time, one of the two is kept. Deleting a directory costs only time. A table whose columns
are not those of this version is named `.foreign.parquet`.

Reading the descriptions of a thousand sessions takes as long as a question. So a directory has a stamp: an empty file
whose name covers the sizes and times of the segments, of the description and of index.json. While the stamp fits, the
description is not read. A new mark changes the description, so the stamp no longer fits, and the description is read.
If it says nothing new about the messages, the tables stay, and only the stamp is replaced.
"""

import errno
import fnmatch
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Final, Self

from msgspec import Struct
from msgspec.structs import replace

from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.session_dir import (
    INDEX_FILE,
    SEGMENTS,
    SESSION_FILE,
    TABLES_PREFIX,
    SessionInfo,
    indexed_segments,
)
from fleet.recording.tools.summary import of_session
from fleet.recording.tools.table_export import export
from fleet.recording.tools.table_formats import ParquetSink
from fleet.recording.tools.tables import Column, Layout
from schemas import messages
from schemas.topics import TOPICS

_PART: Final = ".part"
_NOTE: Final = "damage"
"""Name of the file that describes the parts of the session that could not be read."""
_FOREIGN: Final = ".foreign.parquet"
_OPEN: Final = "recording"
"""Name of the empty file that says that the recorder had not closed the session when its tables were made. If it
still has not, the session was cut short, so its losses are looked up again."""
_LEFT_OUT: Final = "left_out"
"""Name of the file with the messages that are not in the table of their key: a list of key, cause and count."""
_STAMP: Final = "stamp-"
"""Prefix of the empty file whose name says for which state of the session the tables were made."""
_FORMAT: Final = "4"
"""Increase it if the contents of a directory change, so that all directories are made again."""
STALE_PART_S: Final = 600.0
"""If nothing changes in an unfinished directory for this time, its process was killed. A running process writes to a
table every few seconds."""
_MAX_TRIES: Final = 4
"""Maximum number of attempts to make tables. Another question may delete them if the session has grown meanwhile."""


class CachedTables(Struct, frozen=True):
    """The tables of one session."""

    session: Path
    directory: Path
    words: str = ""
    """The parts of the session that could not be read, in words. Empty if all could be read."""

    names: tuple[str, ...] = ()
    """The files in the directory."""

    @classmethod
    def of(cls, session: Path, directory: Path) -> Self:
        """Return the tables in a directory. Raises OSError, for example if another question deletes them now."""
        names = tuple(sorted(os.listdir(directory)))  # noqa: PTH208 - a path for each name costs half of a question
        note = directory / _NOTE
        return cls(session, directory, note.read_text(encoding="utf-8") if _NOTE in names else "", names)

    def with_words_of_now(self) -> Self:
        """Return the tables. If they had no `words` and the session was not closed, set `words` to its state now."""
        return replace(self, words=self.words or _words(Session(self.session))) if _OPEN in self.names else self

    def files(self, message: str) -> Iterator[Path]:
        """Yield the tables of a message type. There are several if its fields changed within the session."""
        name = re.compile(rf"{re.escape(message)}(-\d+)?(\.foreign)?\.parquet")
        yield from (self.directory / each for each in self.names if each.startswith(message) and name.fullmatch(each))

    def left_out(self) -> LeftOut:
        """Return the messages that are not in the table of their key. Raises OSError."""
        found = LeftOut()
        if _LEFT_OUT in self.names:
            for key, cause, count in json.loads((self.directory / _LEFT_OUT).read_text(encoding="utf-8")):
                found.add(key, LeftOutCause(cause), count)
        return found

    def has(self, stamp: str) -> bool:
        """Return True if the session was in this state when its description was last read."""
        return f"{_STAMP}{stamp}" in self.names

    def put(self, stamp: str) -> None:
        """Note the state of the session for the next question, if the directory can be written."""
        with suppress(OSError):
            (self.directory / f"{_STAMP}{stamp}").touch()
            for name in self.names:
                if name.startswith(_STAMP):
                    (self.directory / name).unlink(missing_ok=True)

    def is_foreign(self, file: Path) -> bool:
        """Return True if the columns of a table are not those of this version."""
        return file.name.endswith(_FOREIGN)


def tables_of(session: Path) -> CachedTables:
    """Return the tables of a session. Make them now if they do not exist.

    Raises NoSession, FormatMissing, and OSError if they can be written neither in the session nor elsewhere, or if the
    session grows too fast.
    """
    for _ in range(_MAX_TRIES):
        state = _State.of(session)
        if (found := _stamped(session, state)) is not None:
            return found
        name = f"{TABLES_PREFIX}{state.digest(session)}"
        places = [home / name for home in _homes(session)]
        for place in places:
            with suppress(FileNotFoundError):
                found = CachedTables.of(session, place)
                found.put(state.stamp)
                return found.with_words_of_now()
        if not session.exists():
            break
        errors: list[OSError] = []
        for place in places:
            try:
                return _made(session, place, state.stamp)
            except FileNotFoundError:  # the session is gone, or another question has seen a newer state of it
                break
            # Reading does not raise OSError, because unreadable parts count as damage. So the disk is full or broken,
            # or the folder is read-only, and another disk may have room for the tables.
            except OSError as error:
                errors.append(error)
        else:
            raise errors[0]
    if session.exists():
        raise OSError(errno.EAGAIN, f"the session grows too fast: {os.strerror(errno.EAGAIN)}")
    raise NoSession(f"{session} is gone: it was deleted meanwhile.")


def _stamped(session: Path, state: "_State") -> CachedTables | None:
    """Return the tables whose stamp fits this state, from the session or else from the temporary files."""
    stamp = state.stamp
    elsewhere = ((home, _names(home)) for home in _homes(session) if home != session)
    for home, names in chain([(session, state.names)], elsewhere):
        for name in names:
            if name.startswith(TABLES_PREFIX) and not name.endswith(_PART):
                with suppress(OSError):
                    found = CachedTables.of(session, home / name)
                    if found.has(stamp):
                        return found.with_words_of_now()
    return None


def _made(session: Path, place: Path, stamp: str) -> CachedTables:
    """Make the tables of a session. Raises OSError, a FileNotFoundError if the session or the tables are gone."""
    if place.parent != session:  # never create the session's directory again after the quota has deleted it
        place.parent.mkdir(parents=True, exist_ok=True)
    _drop_stale_parts(place.parent)
    part = Path(tempfile.mkdtemp(prefix=f"{place.name}-", suffix=_PART, dir=place.parent))
    try:
        read = Session(session)
        exported = export(read.rows(), part, _Sink)
        if exported.left_out.total:
            counts = [(key, cause, count) for (key, cause), count in exported.left_out.counts.items()]
            (part / _LEFT_OUT).write_text(json.dumps(counts), encoding="utf-8")
        if words := _words(read):
            (part / _NOTE).write_text(words, encoding="utf-8")
        if read.description is not None and not read.description.closed:
            (part / _OPEN).touch()
        (part / f"{_STAMP}{stamp}").touch()
        with suppress(OSError):  # another question has made it meanwhile
            part.rename(place)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    _drop_others(place)
    return CachedTables.of(session, place)


def _words(session: Session) -> str:
    """Return the damage of a session in words, as `fleet find` and `fleet sessions` print it. Empty if it is whole."""
    return session.damage_words or of_session(session).words


class _Sink(ParquetSink):
    """A table in the cache. Its name says whether its columns are those of this version."""

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        message = re.sub(r"-\d+$", "", path.stem)
        ours = _layouts().get(message)
        is_foreign = ours is not None and _facts(columns) != ours
        super().__init__(path.with_name(f"{path.stem}{_FOREIGN}") if is_foreign else path, columns)


@cache
def _layouts() -> dict[str, list[tuple[str, str]]]:
    """Return names and kinds of the columns of our tables, by message."""
    names = {topic.message for topic in TOPICS.values()}
    return {name: _facts(Layout(messages.message_class(name).DESCRIPTOR).columns) for name in names}


def _facts(columns: Sequence[Column]) -> list[tuple[str, str]]:
    return [(each.name, f"{each.kind} {each.item}") for each in columns]


def drop_orphans(place: Path) -> None:
    """Delete the tables of single files that are gone. Tables of a session's directory were deleted with it."""
    for home in place.glob(".*.mcap"):
        if home.is_dir() and not (place / home.name[1:]).exists():
            for tables in home.glob(f"{TABLES_PREFIX}*"):
                shutil.rmtree(tables, ignore_errors=True)
            with suppress(OSError):  # the directory has other files
                home.rmdir()


def _drop_stale_parts(home: Path) -> None:
    """Delete unfinished directories of processes that were killed or lost power."""
    for part in home.glob(f"{TABLES_PREFIX}*{_PART}"):
        with suppress(OSError):
            newest = max(each.stat().st_mtime for each in (part, *part.iterdir()))
            if time.time() - newest > STALE_PART_S:
                shutil.rmtree(part, ignore_errors=True)


def _drop_others(place: Path) -> None:
    """Delete the tables of other states of the session.

    A file that cannot be deleted, for example because another question is reading it, is deleted next time.
    """
    for other in place.parent.glob(f"{TABLES_PREFIX}*"):
        if other != place and not other.name.endswith(_PART):
            shutil.rmtree(other, ignore_errors=True)


def _homes(session: Path) -> Iterator[Path]:
    """Yield the places where the tables may be: in the session, or among temporary files if that is not possible."""
    home = session if session.is_dir() else session.parent / f".{session.name}"
    yield home
    owner = hashlib.sha256(str(home.absolute()).encode()).hexdigest()[:12]
    # Each user has their own directory, because that of another user cannot be written.
    user = f"zenoh-car-fleet-tables-{os.getuid() if hasattr(os, 'getuid') else 0}"
    yield Path(tempfile.gettempdir()) / user / owner / session.name


def _names(directory: Path) -> list[str]:
    with suppress(NotADirectoryError, FileNotFoundError):
        return os.listdir(directory)  # noqa: PTH208 - a path for each name costs half of a question
    return []


@cache
def _layouts_text() -> str:
    return repr(sorted(_layouts().items()))


class _State(Struct, frozen=True):
    """Sizes and times of the files of a session."""

    names: tuple[str, ...]
    """All names in the session. Empty if it is a file."""
    segments: tuple[str, ...]
    """Each segment with its size and time."""
    description: tuple[str, ...]
    """Size, time and inode of the files that describe the messages. Each change makes a new inode."""

    @classmethod
    def of(cls, session: Path) -> Self:
        names = tuple(sorted(_names(session)))
        if names or session.is_dir():
            directory, files = os.fspath(session), fnmatch.filter(names, SEGMENTS)
        else:
            directory, files = os.fspath(session.parent), [session.name]
        segments = [
            f"{name} {state.st_size} {state.st_mtime_ns}" for name in files if (state := _stat(directory, name))
        ]
        description = [
            f"{name} {state.st_size} {state.st_mtime_ns} {state.st_ino}"
            for name in (SESSION_FILE, INDEX_FILE)
            if name in names and (state := _stat(directory, name))
        ]
        return cls(names, tuple(segments), tuple(description))

    @property
    def stamp(self) -> str:
        """Return the stamp of the tables that were made for this state by this version."""
        return _hash(_FORMAT, _layouts_text(), *self.segments, *self.description)

    def digest(self, session: Path) -> str:
        """Return the digest of this state. It reads the description."""
        # If a version names a column differently, all tables are made again.
        return _hash(_FORMAT, _layouts_text(), *self.segments, _described(session))


def _stat(directory: str, name: str) -> os.stat_result | None:
    # A question looks at a thousand sessions: os.stat takes a third of the time of Path.glob and Path.stat.
    with suppress(FileNotFoundError):  # the quota deletes it meanwhile
        return os.stat(f"{directory}{os.sep}{name}")  # noqa: PTH116
    return None


def _hash(*facts: str) -> str:
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]


def _described(session: Path) -> str:
    """Return the part of the description that is about the messages. A new mark does not change it."""
    info = SessionInfo.read(session)
    files = [each["file"] for each in indexed_segments(session)]
    told = None if info is None else (info.closed, info.messages, info.error, info.gone, info.origin)
    return repr((told, files))
