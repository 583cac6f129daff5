"""Keeps the tables of a session as Parquet beside it, for questions to many sessions.

The tables of one state of a session are in the directory `.tables-<digest>`. The digest is of its files, their sizes
and and times, and of the columns of our tables. So a session that grew has another directory, and the old one goes. A
directory has its name only when it is whole: two questions at once make it twice, and one of the two is kept. Whoever
deletes it loses nothing but time.
"""

import errno
import hashlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from fleet.recording.reading.session import NoSession, Session
from fleet.recording.session_dir import SEGMENTS
from fleet.recording.tools.export import export
from fleet.recording.tools.table_formats import ParquetSink
from fleet.recording.tools.tables import Layout
from schemas import messages
from schemas.topics import TOPICS

PREFIX: Final = ".tables-"
_PART: Final = ".part"
_READ_ONLY: Final = (errno.EACCES, errno.EPERM, errno.EROFS)


@dataclass(frozen=True, slots=True)
class CachedTables:
    """The tables of one session."""

    session: Path
    directory: Path
    words: str = ""
    """What of the session could not be read; empty if all was."""

    def files(self, message: str) -> Iterator[Path]:
        """Yield the tables of a message type. There are several if its fields changed within the session."""
        name = re.compile(rf"{re.escape(message)}(-\d+)?\.parquet")
        yield from (each for each in sorted(self.directory.iterdir()) if name.fullmatch(each.name))


def is_cached(session: Path) -> bool:
    """Return True if the tables of a session are made, and of its present state."""
    return any(place.is_dir() for place in _places(session))


def tables_of(session: Path) -> CachedTables:
    """Return the tables of a session, made now if they are not there. Raises NoSession, OSError, FormatMissing."""
    for place in _places(session):
        if place.is_dir():
            note = place / "damage"
            return CachedTables(session, place, note.read_text(encoding="utf-8") if note.exists() else "")
    errors: list[OSError] = []
    for place in _places(session):
        try:
            return _made(session, place)
        except OSError as error:
            if error.errno not in _READ_ONLY:  # a full disk, for example: it is the same elsewhere
                raise
            errors.append(error)
    raise errors[0]


def _made(session: Path, place: Path) -> CachedTables:
    place.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f"{place.name}-", suffix=_PART, dir=place.parent))
    try:
        read = Session(session)
        export(read.rows(), part, ParquetSink)
        words = read.damage_words
        if words:
            (part / "damage").write_text(words, encoding="utf-8")
        with suppress(OSError):  # another question has made it meanwhile
            part.rename(place)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    shutil.rmtree(part, ignore_errors=True)
    _drop_others(place)
    if not place.is_dir():
        raise NoSession(f"{session} is gone: it was deleted meanwhile.")
    return CachedTables(session, place, words)


def _drop_others(place: Path) -> None:
    """Delete the tables of other states of the session. One that another question reads goes at the next time."""
    for other in place.parent.glob(f"{PREFIX}*"):
        if other != place and not other.name.endswith(_PART):
            shutil.rmtree(other, ignore_errors=True)


def _places(session: Path) -> tuple[Path, Path]:
    """Return where the tables may be: in the session, or for a folder that is read-only among temporary files."""
    name = f"{PREFIX}{_digest(session)}"
    home = session if session.is_dir() else session.parent / f".{session.name}"
    owner = hashlib.sha256(str(home.absolute()).encode()).hexdigest()[:12]
    return home / name, Path(tempfile.gettempdir()) / "zenoh-car-fleet-tables" / owner / session.name / name


@cache
def _layout() -> str:
    """Return the columns of all our tables. Where a version names one differently, all caches are made anew."""
    columns = (Layout(messages.message_class(each.message).DESCRIPTOR).columns for each in TOPICS.values())
    return repr([[(each.name, each.kind) for each in table] for table in columns])


def _digest(session: Path) -> str:
    files = sorted(session.glob(SEGMENTS)) if session.is_dir() else [session]
    facts = [_layout()]
    for each in files:
        with suppress(FileNotFoundError):  # the quota deletes it meanwhile
            state = each.stat()
            facts.append(f"{each.name} {state.st_size} {state.st_mtime_ns}")
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]
