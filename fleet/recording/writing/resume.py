"""Finds an interrupted session that can be continued, because publishers still cache the lost messages.

A recorder interrupts its session if it is killed, or if its disk fails. What was lost then, and until the next recorder
has started, is nowhere else. That holds also if no file of the session can be read.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from fleet.recording import session_dir
from fleet.recording.message_identity import identity
from fleet.recording.reading.session import NoSession, Recorded, Session
from fleet.recording.session_dir import SessionInfo
from fleet.recording.session_lookup import newest_first
from fleet.recording.time_spec import iso_ns
from fleet.recording.writing.backfill_plan import GAP_MARGIN_S
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
    """Messages recorded since a few seconds before then: key, sequence, identity (message_identity.py)."""
    clocks: PublisherClocks = field(default_factory=PublisherClocks)
    """The publishers' clocks, as far as these messages show them."""


def find_interrupted(root: Path, fleet: str, now_ns: int) -> ResumePoint:
    """Return the resume point of the latest session below `root`.

    It has no name if that session was closed, has no readable description, or was last written more than 2 * CACHE_S
    ago.
    """
    path = _find_latest(root, fleet, now_ns)
    if path is None:
        return ResumePoint("", now_ns)
    start_ns = now_ns - int(RESUME_WINDOW_S * 1e9)
    # Some queries ask a little further back. Of a publisher whose clock is ahead, the answers look young enough.
    known_from_ns = start_ns - int(2 * GAP_MARGIN_S * 1e9)
    # If the recorder was killed twice, the first gap may not be backfilled yet. So read the sessions before it, too.
    chain = _chain(path, known_from_ns)
    since_ns, known, clocks = max(start_ns, _started_ns(chain[-1])), set[tuple[str, int, int]](), PublisherClocks()
    for row in _recorded_since(chain, known_from_ns):
        known.add((row.key, row.sequence, identity(row.message, row.payload, row.published_ns)))
        clocks.add(row.key, row.published_ns, row.recorded_ns)
    return ResumePoint(path.name, since_ns, frozenset(known), clocks)


def _recorded_since(chain: Iterable[Path], start_ns: int) -> Iterator[Recorded]:
    """Yield the messages that can be read."""
    for path in chain:
        with suppress(NoSession, OSError):  # the disk that has failed, or the recorder was killed before its first file
            yield from Session(path).messages(start_ns=start_ns)


def _chain(path: Path, start_ns: int) -> list[Path]:
    """Return a session and those that it continues, latest first, back to the one that contains `start_ns`."""
    found = [path]
    while _started_ns(found[-1]) > start_ns:
        info = SessionInfo.read(found[-1])
        name = info.continues if info is not None else ""
        earlier = path.parent / name
        if not name or Path(name).name != name or earlier in found or SessionInfo.read(earlier) is None:
            break
        found.append(earlier)
    return found


def _started_ns(path: Path) -> int:
    """Return when a session was started. 0 if its description does not say so."""
    info = SessionInfo.read(path)
    with suppress(ValueError, OverflowError):  # edited by hand
        return 0 if info is None else iso_ns(info.started)
    return 0


def _find_latest(root: Path, fleet: str, now_ns: int) -> Path | None:
    """Return the latest session if its recorder ended a moment ago without closing it. Otherwise return None."""
    # The latest by its start, not by its name: a user may have renamed a session, or cut a part of one and kept it
    # here. A session of the future was recorded with a wrong clock, and says nothing about the time before this one.
    for path in newest_first(root):
        info = SessionInfo.read(path)
        if info is None or info.fleet != fleet or not 0 < _started_ns(path) <= now_ns:
            continue
        return path if not info.closed and now_ns - _written_ns(path) < CACHE_S * 2e9 else None
    return None


def _written_ns(path: Path) -> int:
    """Return when a recorder last wrote a session. 0 if nothing can be seen of it."""
    # A quota writes session.json, too.
    files = sorted(path.glob(session_dir.SEGMENTS)) or [path / session_dir.SESSION_FILE]
    with suppress(OSError):
        return files[-1].stat().st_mtime_ns
    return 0
