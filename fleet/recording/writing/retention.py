"""The quota of a recorder: how large all sessions may be together, and which ones it removes."""

import contextlib
import errno
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fleet.recording.session_dir import SESSION_FILE, SessionInfo
from fleet.recording.writing.disk_space import MB

SESSIONS_PER_QUOTA: Final = 10
"""Minimum sessions in a quota. The quota removes whole sessions, so each uses at most a tenth unless told otherwise."""
_UNCLOSED_IN_USE_S: Final = 60.0
"""Age below which an unclosed session may still belong to another recorder."""


@dataclass(frozen=True, slots=True)
class Quota:
    """Maximum size of all sessions together, and of one, in bytes; 0 is no limit."""

    total: int = 0
    """The oldest unmarked sessions are removed first."""
    session: int = 0
    """Size at which a session is closed and the next one begins; 0: a tenth of `total`."""

    @property
    def session_limit(self) -> int:
        """Return the maximum size of one session in bytes; 0 is no limit."""
        return self.session or self.total // SESSIONS_PER_QUOTA

    @property
    def refusal(self) -> str:
        """Return why the two sizes do not fit each other. Empty if they do."""
        if not self.session or not self.total or self.session <= self.total // 2:
            return ""
        return (
            f"--session-size: {self.session / 10**6:g} MB is more than half of --quota: at most "
            f"{self.total / 2 / 10**6:g} MB are allowed, because the quota removes whole sessions"
        )

    def enforce(self, root: Path, keep: Path) -> tuple[list[Path], str]:
        """Remove the oldest sessions below `root` until all fit: (removed sessions, a warning if they still do not).

        Spare `keep`, marked sessions, directories of other programs and sessions that cannot be removed.
        """
        if not self.total:
            return [], ""
        sizes = {path.parent: _size(path.parent) for path in root.glob(f"*/{SESSION_FILE}")}
        over = sum(sizes.values()) - self.total
        removed = []
        for session in sorted(sizes, key=lambda session: session.name):
            if over <= 0:
                break
            if session != keep and _may_go(session):
                try:
                    _remove(session)
                except OSError:
                    continue  # perhaps another user's; the warning reports the excess
                removed.append(session)
                over -= sizes[session]
        why = f"by {over / MB:.1f} MB that are marked, in use or not to be removed"
        return removed, f"{root} has more than its quota, {why}" if over > 0 else ""

    @staticmethod
    def removal(session: Path) -> str:
        """Return the news that this session was removed."""
        return f"{session} is removed, the oldest session without a mark: the quota is full"


def _remove(session: Path) -> None:
    """Delete a session. Raises OSError."""
    try:
        shutil.rmtree(session)
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise
        shutil.rmtree(session)  # a question was making its tables in it, and fails now


def _size(session: Path) -> int:
    """Return the size of a session in bytes. Ignore files that disappear meanwhile."""
    found = 0
    for each in session.rglob("*"):
        with contextlib.suppress(OSError):
            found += each.stat().st_size if each.is_file() else 0
    return found


def _may_go(session: Path) -> bool:
    description = SessionInfo.read(session)
    if description is None or description.kept:
        return False
    try:
        newest = max((each.stat().st_mtime for each in session.iterdir() if not each.name.startswith(".")), default=0.0)
    except OSError:
        return False
    return description.closed or time.time() - newest > _UNCLOSED_IN_USE_S
