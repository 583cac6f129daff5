"""The space on a recorder's disk: how much is free, how much each step needs, and texts for a lack of space."""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Final

from msgspec import Struct

MB: Final = 1_000_000
FREE_WARNING_FACTOR: Final = 4
"""Warn if less than this multiple of the reserve is free."""
MIN_START_BYTES: Final = 500_000
"""Minimum free space above the reserve to begin a session."""
MAX_RESUME_BYTES: Final = 5 * MB
"""Maximum space above the reserve to wait for before resuming. With less, the recorder would write many files of one
second each. With more, recording might never resume on a small disk."""
PROBE_BYTES: Final = 4096
"""Size of the test file that shows whether a directory can be written: one block of most disks."""
MIN_CLOSE_BYTES: Final = 200_000
"""Minimum free space to write the end of a session: the index of its last file needs it."""


def free_bytes(path: Path) -> int:
    """Return the free space on the disk where `path` is or would be. Raises OSError if it cannot be determined."""
    return shutil.disk_usage(next(each for each in (path, *path.absolute().parents) if each.exists())).free


class Reserve(Struct, frozen=True):
    """The space that a recording leaves free. If less is free, the recording pauses."""

    bytes: int = 50 * MB

    @property
    def to_begin(self) -> int:
        """Free space that a new session needs."""
        return self.bytes + MIN_START_BYTES

    @property
    def to_resume(self) -> int:
        """Free space at which a paused recording continues."""
        return self.bytes + max(min(self.bytes, MAX_RESUME_BYTES), MIN_START_BYTES)

    @property
    def to_end(self) -> int:
        """Free space that must remain when a file is ended."""
        return self.bytes + MIN_CLOSE_BYTES

    def why_broken(self, free: int) -> str:
        """Return why recording must pause with this much free space. Empty if it need not."""
        broken = f"{free / MB:.1f} MB are left on the disk, {self.bytes / MB:g} MB must stay free"
        return broken if free < self.bytes else ""

    def warning(self, root: Path, free: int) -> str:
        """Return the warning that the space will soon be used up. Empty if there is plenty."""
        plenty = free >= self.bytes * FREE_WARNING_FACTOR
        return "" if plenty else f"{root}: the disk is nearly full, {free / MB:.0f} MB are left"

    def why_unwritable(self, root: Path) -> str:
        """Return why no session can begin in this directory. Empty if one can.

        The directory is created if it is missing.
        """
        try:
            root.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=root) as file:
                file.write(bytes(PROBE_BYTES))
                file.flush()
                os.fsync(file.fileno())
            return shortage(free_bytes(root), self.to_begin)
        except OSError as error:
            return error.strerror or str(error)


def shortage(free: int, needed: int) -> str:
    """Return how much space is missing, in words. Empty if none is."""
    return "" if free >= needed else f"{free / MB:.1f} MB are left on the disk, {needed / MB:.1f} MB are needed"
