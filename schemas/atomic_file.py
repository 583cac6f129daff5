"""Writes files atomically: readers see the old file or the whole new one, never a part."""

import contextlib
import os
from pathlib import Path


def write_atomically(path: Path, data: bytes, *, sync: bool = False) -> None:
    """Write a file, or replace it and keep its mode. sync: True to survive a power failure. Raises OSError."""
    scratch = path.with_name(f".{path.name}.new")
    try:
        with scratch.open("wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        if path.exists():
            scratch.chmod(path.stat().st_mode)
        scratch.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise
