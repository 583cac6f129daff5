"""A lock between the processes of one user: a locked file. It ends with its holder, even if the holder is killed."""

import errno
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK_TIMEOUT_S: Final = 10.0
"""Maximum time for which `held` waits. A change of a file by another program takes some milliseconds."""
_LOCK_POLL_S: Final = 0.02
_MODE: Final = 0o600


class FileLock:
    """A lock on one file, which is made if it is missing."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    @property
    def is_held(self) -> bool:
        """True if this object holds the lock."""
        return self._descriptor is not None

    def try_take(self) -> bool:
        """Take the lock if it is free. Return True if this object holds it now. Raises OSError if locking fails."""
        if self._descriptor is not None:
            return True
        self._path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, _MODE)
        try:
            taken = _lock(descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        if not taken:
            os.close(descriptor)
            return False
        self._descriptor = descriptor
        return True

    @contextmanager
    def held(self) -> Iterator[None]:
        """Wait for the lock, hold it, and release it. Raises TimeoutError if another one holds it, else OSError."""
        deadline = time.monotonic() + LOCK_TIMEOUT_S
        while not self.try_take():
            if time.monotonic() > deadline:
                raise TimeoutError(errno.ETIMEDOUT, "another program holds it: try again", str(self._path))
            time.sleep(_LOCK_POLL_S)
        try:
            yield
        finally:
            self.release()

    def release(self) -> None:
        """Release the lock. The file stays, as another process may have it open already."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _lock(descriptor: int) -> bool:
    """Lock an open file until it is closed. Return False if another process has locked it. Raises OSError."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # Windows raises the second one
        return False
    return True
