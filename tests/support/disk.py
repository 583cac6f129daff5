"""A disk that a test can fill: one of its own where tests may mount one, else a reserve on the disk of the test."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BALLAST = 1_200_000_000
"""Size of a file that fills the disk. Half of it is more than other processes write to a shared disk meanwhile."""
TINY = 6_000_000
SMALL = 150_000_000
KEPT = SMALL // 3
BARE = 70_000_000
"""Size of a disk that has little more than the reserve of `fleet up`, 50 MB, and can be filled to the last byte."""


def can_mount() -> bool:
    """Return True if this user may mount a tmpfs."""
    return (
        sys.platform == "linux"
        and os.geteuid() == 0
        and not subprocess.run(
            ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False
        ).returncode
    )


MAY_MOUNT = can_mount()
DISKS = ["keep free", *(["really full"] if MAY_MOUNT else [])]
"""Ways to fill a disk. A disk of its own, if one can be mounted, has no other writers."""


class Disk:
    """A disk that a test can fill and empty."""

    def __init__(self, root: Path, ballast: Path, size: int, options: tuple[str, ...]) -> None:
        self.root = root
        self.options = options
        self._ballast = ballast
        self._size = size

    def fill(self, but: int = 0) -> None:
        with self._ballast.open("wb") as file:
            while True:
                size = min(self._size, shutil.disk_usage(self._ballast.parent).free) - but
                try:
                    os.posix_fallocate(file.fileno(), 0, size)
                except OSError as error:  # the recorder has written meanwhile
                    if error.errno != errno.ENOSPC:
                        raise
                    file.truncate(0)
                else:
                    return

    def free(self) -> None:
        self._ballast.unlink()


@contextmanager
def disk(kind: str, place: Path) -> Iterator[Disk]:
    """Yield a disk with a reserve, or one that can be filled to the last byte."""
    if not MAY_MOUNT:
        keep = shutil.disk_usage(place).free - BALLAST // 2
        try:
            yield Disk(place / "sessions", place / "ballast", BALLAST, ("--keep-free", str(keep)))
        finally:
            (place / "ballast").unlink(missing_ok=True)
        return
    size, keep, ballast = {
        "keep free": (SMALL, KEPT, SMALL - KEPT // 2),
        "really full": (TINY, 0, TINY),
        "full for a while": (BARE, 0, BARE),
    }[kind]
    mounted = place / "disk"
    mounted.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(mounted)], check=True)
    try:
        yield Disk(mounted / "sessions", mounted / "ballast", ballast, ("--keep-free", str(keep)))
    finally:
        subprocess.run(["umount", "-l", str(mounted)], check=True)
