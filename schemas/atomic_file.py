"""Writes files atomically: readers see the old file or the whole new one, never a part."""

import contextlib
import os
from pathlib import Path


def write_atomically(path: Path, data: bytes, *, sync: bool = False, private: bool = False) -> None:
    """Write a file, or replace it and keep its mode. sync: True to survive a power failure. Raises OSError.

    private: nobody but the user may read it, at no time.
    """
    scratch = path.with_name(f".{path.name}.new")
    try:
        if private:
            scratch.unlink(missing_ok=True)
            scratch.touch(0o600, exist_ok=False)
        with scratch.open("wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        if path.exists() and not private:
            scratch.chmod(path.stat().st_mode)
        scratch.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise
