"""Writes files atomically: readers see the old file or the whole new one, never a part. All state is written so.

Of several writers, the last one wins. Programs that change a part of a file need a lock (`process.file_lock`).
"""

import contextlib
import os
import threading
from pathlib import Path
from typing import Final

DAMAGE: Final = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError)
"""The exceptions that reading one of our JSON files may raise after another program has changed it."""


def write_atomically(path: Path, data: bytes, *, sync: bool = False, private: bool = False) -> None:
    """Write a file, or replace it and keep its mode. Raises OSError.

    With `sync`, the data is on the disk before the file is replaced, so after a power failure either the old file or
    the new one is whole. With `private`, only the user can read the file, also while it is being written, and its mode
    becomes 0600.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.new")
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


def write_state(path: Path, text: str, *, sync: bool = False, private: bool = False) -> None:
    """Write a state file with `write_atomically`. Make its directory if it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.encode(), sync=sync, private=private)
