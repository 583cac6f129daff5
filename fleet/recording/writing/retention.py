"""Room on the disk: how much there is, what a session takes, which old sessions give way to new ones."""

import contextlib
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from fleet.recording.session_dir import DESCRIPTION, SessionInfo

_IN_USE_S: Final = 60.0
"""A session that was not closed, and was written to since then, may be another recorder's."""


def free_bytes(path: Path) -> int:
    """What may still be written where `path` is; raises OSError."""
    return shutil.disk_usage(path).free


def free_bytes_for(path: Path) -> int:
    """What may be written where `path` is to be made; raises OSError."""
    return free_bytes(next(each for each in (path, *path.absolute().parents) if each.exists()))


def size(session: Path) -> int:
    """What a session takes, bytes; of one that somebody removes meanwhile, what was left."""
    found = 0
    for each in session.rglob("*"):
        with contextlib.suppress(OSError):
            found += each.stat().st_size if each.is_file() else 0
    return found


def make_room(root: Path, limit_bytes: int, keep: Path) -> tuple[list[Path], int]:
    """Remove the oldest sessions below `root` until all take no more than the limit: (removed, what is still over).

    `keep`, marked sessions and what is no session of ours are left alone, and what cannot be removed.
    """
    sizes = {session: size(session) for session in _sessions(root)}
    over = sum(sizes.values()) - limit_bytes
    removed = []
    for session in sorted(sizes, key=lambda session: session.name):
        if over <= 0:
            break
        if session != keep and _may_go(session):
            try:
                shutil.rmtree(session)
            except OSError:
                continue  # somebody else's, perhaps: what is over is told
            removed.append(session)
            over -= sizes[session]
    return removed, max(0, over)


def _sessions(root: Path) -> Iterator[Path]:
    return (path.parent for path in root.glob(f"*/{DESCRIPTION}"))


def _may_go(session: Path) -> bool:
    description = SessionInfo.read(session)
    if description is None or description.kept:
        return False
    try:
        newest = max((each.stat().st_mtime for each in session.iterdir()), default=0.0)
    except OSError:
        return False
    return description.closed or time.time() - newest > _IN_USE_S
