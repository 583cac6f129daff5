"""Takes the rights of root from a test: root may read and list everything."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

NOBODY: Final = 65534
_PASS: Final = 0o011
"""The right of others, and of root's group, to pass through a directory. The process stays in that group."""


@contextmanager
def no_superuser(seen: Path) -> Iterator[None]:
    """Run as a user without all rights, who may read `seen`."""
    if os.geteuid():
        yield
        return
    for path in (seen, *seen.parents):
        if path.stat().st_mode & _PASS != _PASS:
            path.chmod(path.stat().st_mode | _PASS)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)
