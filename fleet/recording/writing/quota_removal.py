"""Removes recordings that exceed the quota of a recorder (fleet/quota.py). quota_choice.py decides what is removed.

Removed recordings are listed: segments in the session.json of their session, whole sessions in `removed.json` beside
the sessions.
"""

import contextlib
import errno
import shutil
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.quota import Quota
from fleet.recording import session_dir
from fleet.recording.pins import Pin, pins_of
from fleet.recording.reading.mcap_reader import McapReader, NotMcap
from fleet.recording.session_dir import SESSION_FILE, SessionInfo
from fleet.recording.time_spec import iso, iso_ns
from fleet.recording.writing.disk_space import MB
from fleet.recording.writing.quota_choice import Spans, StoredSegment, StoredSession, Taking, choose

MAX_REMOVED: Final = 1000
"""Maximum number of removed sessions in `removed.json`, with 200 bytes each. The newest ones are listed."""
_UNCLOSED_IN_USE_S: Final = 60.0
"""An unclosed session that was written within this time may still belong to another recorder."""


class Enforced(Struct):
    """Result of one enforcement of the quota."""

    removed: list[Path] = field(default_factory=list)
    """Sessions that were removed as a whole."""
    news: list[str] = field(default_factory=list)
    """News for a person: each removed session, and the first minutes that a session loses."""
    warning: str = ""
    """Why the sessions are still too large together."""


def enforce(quota: Quota, root: Path, keep: Path, pins: Iterable[Pin] = ()) -> Enforced:
    """Remove segments below `root` until all sessions fit.

    Spare `keep`, marked sessions, sessions in use, directories of other programs and sessions that cannot be changed.
    pins: the pins of `keep`, because its session.json may not have them yet.
    """
    done = Enforced()
    if not quota.total:  # without a quota, do not even look at the disk
        return done
    paths = [path.parent for path in root.glob(f"*/{SESSION_FILE}")]
    over = quota.excess(sum(map(_size, paths)))
    if not over:
        return done
    infos = {path: info for path in paths if (info := SessionInfo.read(path)) is not None}
    spans = _pinned_times(infos, keep, pins)
    stored = [
        _stored(path, info, spans[info.fleet]) for path, info in infos.items() if path != keep and _may_go(path, info)
    ]
    taking = choose(stored, over, quota.total)
    for name in dict.fromkeys([*(each.session for each in taking.segments), *taking.tables, *taking.removed]):
        freed = _take(root / name, infos[root / name], taking, done)
        over -= freed
    if over > 0:
        why = f"by {over / MB:.1f} MB that are marked, pinned, in use or not to be removed"
        done.warning = f"{root} has more than its quota, {why}"
    return done


def _pinned_times(infos: Mapping[Path, SessionInfo], keep: Path, pins: Iterable[Pin]) -> dict[str, Spans]:
    """Return the pinned times of each fleet."""
    times: dict[str, list[tuple[int, int]]] = {}
    for path, info in infos.items():
        own = times.setdefault(info.fleet, [])
        own += [(pin.begin_ns, pin.end_ns) for pin in pins_of(info.pins, info.marks)]
        if path == keep:
            own += [(pin.begin_ns, pin.end_ns) for pin in pins]
    return {fleet: Spans(found) for fleet, found in times.items()}


def _stored(path: Path, info: SessionInfo, spans: Spans) -> StoredSession:
    indexed = {each["file"]: each for each in session_dir.indexed_segments(path)}
    segments: list[StoredSegment] = []
    before_ns = _start_ns(info)
    for file in sorted(path.glob(session_dir.SEGMENTS)):
        with contextlib.suppress(OSError):  # another recorder removes it now
            found = _segment(file, indexed.get(file.name), before_ns)
            segments.append(replace(found, pinned=spans.touch(found.begin_ns, found.end_ns)))
            before_ns = found.end_ns
    tables = sum(_size(each) for each in path.glob(f"{session_dir.TABLES_PREFIX}*"))
    other = _size(path) - tables - sum(each.bytes for each in segments)
    return StoredSession(path.name, tuple(segments), tables, max(other, 0))


def _start_ns(info: SessionInfo) -> int:
    with contextlib.suppress(ValueError, OverflowError):
        return iso_ns(info.started)
    return 0


def _segment(file: Path, entry: Mapping[str, Any] | None, before_ns: int) -> StoredSegment:
    """Return the facts about a segment. entry: its entry in index.json. before_ns: end of the previous segment.

    Raises OSError.
    """
    state = file.stat()
    first_ns, last_ns, messages = ((entry or {}).get(name) for name in ("first_ns", "last_ns", "messages"))
    if not (isinstance(first_ns, int) and isinstance(last_ns, int) and isinstance(messages, int)):
        # For a file without an index, use the time of its last write as its end.
        first_ns, last_ns, messages = before_ns, max(state.st_mtime_ns, before_ns), None
        with contextlib.suppress(NotMcap):
            index = McapReader(file).index()
            if index is not None and (counts := index.statistics) is not None:
                first_ns, last_ns = counts.message_start_time, counts.message_end_time
                messages = counts.message_count
    if messages == 0:
        first_ns = last_ns = before_ns
    return StoredSegment(file.parent.name, file.name, state.st_size, first_ns, last_ns, messages)


def _take(session: Path, info: SessionInfo, taking: Taking, done: Enforced) -> int:
    """Remove the chosen files of one session, and return the freed size in bytes. 0 if it cannot be changed."""
    before = _size(session)
    segments = [each for each in taking.segments if each.session == session.name]
    try:
        if session.name in taking.removed:
            _remove(session)
            done.removed.append(session)
            done.news.append(f"{session} is removed, because the quota is full")
            with contextlib.suppress(OSError):  # the disk is full, but the news names the session, too
                _list_removed(session, info, segments)
            return before
        for tables in session.glob(f"{session_dir.TABLES_PREFIX}*"):
            shutil.rmtree(tables, ignore_errors=True)
        if segments:
            had_pinned = any(each.get("pinned") for each in info.gone)
            _remove_segments(session, segments)
            if not info.gone:
                done.news.append(
                    f"{session}: the quota is full, so its minutes are removed, the oldest unpinned ones first"
                )
            if not had_pinned and any(each.pinned for each in segments):
                done.news.append(
                    f"{session}: pinned minutes were removed, too, because pins may fill only half of the quota"
                )
    except OSError:  # perhaps it belongs to another user; the warning reports the excess
        pass
    return before - _size(session)


def _remove_segments(session: Path, segments: Iterable[StoredSegment]) -> None:
    """Delete segments. List them in session.json first, because otherwise they would count as damage.

    Raises OSError.
    """
    gone = [
        {
            "file": each.file,
            "from": iso(each.begin_ns),
            "to": iso(each.end_ns),
            "messages": each.messages,
            "pinned": each.pinned,
        }
        for each in sorted(segments, key=lambda each: each.file)
    ]
    try:
        session_dir.add_gone(session, gone)
    except OSError as error:
        if not session_dir.is_full(error):
            raise
        (session / str(gone[0]["file"])).unlink(missing_ok=True)  # this makes room for the list
        session_dir.add_gone(session, gone)
    for each in gone:
        (session / str(each["file"])).unlink(missing_ok=True)


def _list_removed(session: Path, info: SessionInfo, segments: Iterable[StoredSegment]) -> None:
    """Add a session to the list of removed sessions. Raises OSError."""
    gone = session_dir.gone_of(info)
    times = [(each["from"], each["to"]) for each in gone] + [
        (iso(each.begin_ns), iso(each.end_ns)) for each in segments
    ]
    entry = {
        "session": session.name,
        "fleet": info.fleet,
        "from": min((begin for begin, _ in times), default=info.started),
        "to": max((end for _, end in times), default=info.started),
        "messages": info.messages,
        "pins": len(info.pins),
        "removed": iso(time.time_ns()),
    }
    place = session.parent
    listed = [*session_dir.removed_sessions(place), entry]
    session_dir.replace(place / session_dir.REMOVED_FILE, {"sessions": listed[-MAX_REMOVED:]})


def _remove(session: Path) -> None:
    """Delete a session. Raises OSError."""
    try:
        shutil.rmtree(session)
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise
        shutil.rmtree(session)  # a question was writing its tables there, and fails now


def _size(session: Path) -> int:
    """Return the size of a session in bytes. Ignore files that disappear meanwhile."""
    found = 0
    for each in session.rglob("*"):
        with contextlib.suppress(OSError):
            found += each.stat().st_size if each.is_file() else 0
    return found


def _may_go(session: Path, description: SessionInfo) -> bool:
    if description.kept:
        return False
    try:
        # Do not look at session.json if there is a segment, because the quota itself writes it.
        files = [*session.glob(session_dir.SEGMENTS)] or [session / SESSION_FILE]
        newest = max(each.stat().st_mtime for each in files)
    except OSError:
        return False
    return description.closed or time.time() - newest > _UNCLOSED_IN_USE_S
