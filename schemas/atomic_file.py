"""Writes files atomically: readers see the old file or the whole new one, never a part. State files are such files."""

import contextlib
import os
from pathlib import Path
from typing import Final

DAMAGE: Final = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError)
"""What reading a JSON file of ours raises if somebody else has written into it."""


def write_atomically(path: Path, data: bytes, *, sync: bool = False, private: bool = False) -> None:
    """Write a file, or replace it and keep its mode. With `sync`, it survives a power failure. Raises OSError.

    If `private`, only the user may read it, at any time.
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


def write_state(path: Path, text: str, *, sync: bool = False, private: bool = False) -> None:
    """Write a state file, whose directory may be missing. As `write_atomically`, which it uses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.encode(), sync=sync, private=private)
