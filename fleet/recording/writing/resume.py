"""Finds an interrupted session that can be continued, because publishers still cache the lost messages."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from fleet.recording import session_dir
from fleet.recording.message_identity import identity
from fleet.recording.reading.session import NoSession, Recorded, Session
from fleet.recording.session_lookup import newest_first
from fleet.recording.time_spec import iso_ns
from fleet.recording.writing.publisher_clocks import PublisherClocks
from schemas.topics import CACHE_S

RESUME_WINDOW_S: Final = 3 * CACHE_S
"""Time before the start of the new session from which publishers may still cache messages."""


class ResumePoint(Struct, frozen=True):
    """End of an interrupted session, at which a new one continues, and the messages that are already recorded."""

    name: str
    """Name of the interrupted session, or an empty text if there is none."""
    since_ns: int
    """Time, by the recorder's clock, from which the new session accepts backfilled messages."""
    known: frozenset[tuple[str, int, int]] = frozenset()
    """Messages recorded since then: key, sequence, identity (message_identity.py)."""
    clocks: PublisherClocks = field(default_factory=PublisherClocks)
    """What these messages show of the publishers' clocks."""


def find_interrupted(root: Path, fleet: str, now_ns: int) -> ResumePoint:
    """Return the resume point of the latest session below `root`.

    It has no name if that session has an end, cannot be read, or was last written more than 2 * CACHE_S ago.
    """
    session = _find_latest(root, fleet, now_ns)
    if session is None:
        return ResumePoint("", now_ns)
    start_ns = now_ns - int(RESUME_WINDOW_S * 1e9)
    # If the recorder was killed twice, the first gap may not be backfilled yet. So read the sessions before it, too.
    chain = [session, *_predecessors(session, start_ns)]
    since_ns, known, clocks = max(start_ns, _started_ns(chain[-1])), set[tuple[str, int, int]](), PublisherClocks()
    for row in _recorded_since(chain, start_ns):
        known.add((row.key, row.sequence, identity(row.message, row.payload, row.published_ns)))
        clocks.add(row.key, row.published_ns, row.recorded_ns)
    return ResumePoint(session.path.name, since_ns, frozenset(known), clocks)


def _recorded_since(chain: Iterable[Session], start_ns: int) -> Iterator[Recorded]:
    for each in chain:
        yield from each.messages(start_ns=start_ns)


def _predecessors(session: Session, start_ns: int) -> list[Session]:
    """Return the sessions that this one continues, latest first, back to the one that contains `start_ns`."""
    found = [session]
    while _started_ns(found[-1]) > start_ns:
        description = found[-1].description
        assert description is not None
        name = description.continues
        if not name or Path(name).name != name:
            break
        try:
            earlier = Session(session.path.parent / name)
        except NoSession:
            break
        if earlier.description is None or earlier.path in [each.path for each in found]:
            break
        found.append(earlier)
    return found[1:]


def _started_ns(session: Session) -> int:
    assert session.description is not None
    return iso_ns(session.description.started)


def _find_latest(root: Path, fleet: str, now_ns: int) -> Session | None:
    """Return the latest session if its recorder ended a moment ago without closing it. Otherwise return None."""
    # The latest by its start, not by its name: a user may have renamed a session, or cut a part of one and kept it
    # here. A session of the future was recorded with a wrong clock, and says nothing about the time before this one.
    for path in newest_first(root):
        description = session_dir.SessionInfo.read(path)
        if description is None or description.fleet != fleet or _starts_after(description, now_ns):
            continue
        if description.closed or description.ended is not None:
            return None
        try:
            session = Session(path)
            written_ns = session.segments[-1].stat().st_mtime_ns
        except (NoSession, OSError):
            return None
        return session if now_ns - written_ns < CACHE_S * 2e9 else None
    return None


def _starts_after(description: session_dir.SessionInfo, now_ns: int) -> bool:
    try:
        return iso_ns(description.started) > now_ns
    except (ValueError, OverflowError):  # edited by hand
        return True
