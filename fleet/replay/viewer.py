"""Rerun's program as a process of ours: where it is, and what it is started with."""

import os
import sys
from pathlib import Path
from typing import Final

_RERUN_ENVIRONMENT: Final = {"CI": "1", "RUST_LOG": "error"}
"""CI is the only switch that keeps Rerun 0.41's program from writing analytics into the user's home."""


def environment() -> dict[str, str]:
    """The environment for any process of Rerun's program."""
    return {**os.environ, **_RERUN_ENVIRONMENT}


def program() -> Path:
    """Rerun's program itself: what is on PATH is a wrapper, and ending that leaves the viewer behind."""
    import rerun_cli  # type: ignore[import-untyped]  # only a wrapper around the program

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(rerun_cli.__file__).parent / name


def has_display() -> bool:
    """Whether a window can be opened, as far as one can tell without opening one."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
