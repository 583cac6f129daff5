"""The session that a new one goes on with: its recorder ended without closing it, and publishers still hold its end."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from fleet.recording import session_dir
from fleet.recording.reading.session import NoSession, Session
from schemas.topics import HELD_S

TAIL_S: Final = 3 * HELD_S
"""Of a session that was cut off: what of it publishers may still hold."""


@dataclass(frozen=True, slots=True)
class ResumePoint:
    """What a new session need not write again."""

    name: str
    """Of the session that was cut off; empty if there is none."""
    since_ns: int
    """What was published before then is no matter of the new session."""
    known: frozenset[tuple[str, int, int]] = frozenset()
    """What was written since then: key, number, time of publication."""


def cut_off(root: Path, fleet: str, now_ns: int) -> ResumePoint:
    """Look for it below `root`: what it has is not written again, what it has not is."""
    session = _last(root, fleet, now_ns)
    if session is None:
        return ResumePoint("", now_ns)
    start_ns = now_ns - int(TAIL_S * 1e9)
    # Killed again before it had what the one before it lacked, it lacks that still.
    chain = [session, *_continued(session, start_ns)]
    known = frozenset(
        (row.key, row.sequence, row.published_ns) for each in chain for row in each.messages(start_ns=start_ns)
    )
    return ResumePoint(session.path.name, max(start_ns, _begun_ns(chain[-1])), known)


def _continued(session: Session, start_ns: int) -> list[Session]:
    """The sessions that one goes on with, the latest first, back to the one in which `start_ns` lies."""
    found = [session]
    while _begun_ns(found[-1]) > start_ns:
        description = found[-1].description
        assert description is not None
        name = description.continues
        if not name or Path(name).name != name:
            break
        try:
            earlier = Session.open(session.path.parent / name)
        except NoSession:
            break
        if earlier.description is None or earlier.path in [each.path for each in found]:
            break
        found.append(earlier)
    return found[1:]


def _begun_ns(session: Session) -> int:
    assert session.description is not None
    return int(datetime.fromisoformat(session.description.started).timestamp() * 1e9)


def _last(root: Path, fleet: str, now_ns: int) -> Session | None:
    """The session of a recorder that ended a moment ago without closing it; None if there is none."""
    there = sorted(root.glob(f"*/{session_dir.DESCRIPTION}"), key=lambda path: path.parent.name)
    for path in reversed(there):
        description = session_dir.SessionInfo.read(path.parent)
        if description is None or description.fleet != fleet:
            continue
        if description.closed or description.ended is not None:
            return None
        try:
            session = Session.open(path.parent)
            written_ns = session.segments[-1].stat().st_mtime_ns
        except (NoSession, OSError):
            return None
        return session if now_ns - written_ns < HELD_S * 2e9 else None
    return None
