"""Measures disk space, and removes old sessions to enforce a quota."""

import contextlib
import shutil
import time
from pathlib import Path
from typing import Final

from fleet.recording.session_dir import SESSION_FILE, SessionInfo

_UNCLOSED_IN_USE_S: Final = 60.0
"""Age below which an unclosed session may still belong to another recorder."""


def free_bytes(path: Path) -> int:
    """Return the free space on the disk of `path` in bytes; raises OSError."""
    return shutil.disk_usage(path).free


def free_bytes_for(path: Path) -> int:
    """Return the free space on the disk where `path` would be created; raises OSError."""
    return free_bytes(next(each for each in (path, *path.absolute().parents) if each.exists()))


def size(session: Path) -> int:
    """Return the size of a session in bytes. Ignore files that disappear meanwhile."""
    found = 0
    for each in session.rglob("*"):
        with contextlib.suppress(OSError):
            found += each.stat().st_size if each.is_file() else 0
    return found


def make_room(root: Path, limit_bytes: int, keep: Path) -> tuple[list[Path], int]:
    """Remove the oldest sessions below `root` until all fit the limit: (removed sessions, bytes still over the limit).

    Spare `keep`, marked sessions, directories of other programs and sessions that cannot be removed.
    """
    sizes = {path.parent: size(path.parent) for path in root.glob(f"*/{SESSION_FILE}")}
    over = sum(sizes.values()) - limit_bytes
    removed = []
    for session in sorted(sizes, key=lambda session: session.name):
        if over <= 0:
            break
        if session != keep and _may_go(session):
            try:
                shutil.rmtree(session)
            except OSError:
                continue  # perhaps another user's; the caller reports the excess
            removed.append(session)
            over -= sizes[session]
    return removed, max(0, over)


def _may_go(session: Path) -> bool:
    description = SessionInfo.read(session)
    if description is None or description.kept:
        return False
    try:
        newest = max((each.stat().st_mtime for each in session.iterdir()), default=0.0)
    except OSError:
        return False
    return description.closed or time.time() - newest > _UNCLOSED_IN_USE_S
