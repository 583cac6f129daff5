"""Ctrl-C during the first and the last steps of a process: imports take 0.1 s and more, and so does the exit."""

# These imports run before Ctrl-C is handled. `typing` would take longer than all others together.
from __future__ import annotations

import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import Final

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as in shells: 128 + SIGINT."""


def end_at_ctrl_c() -> None:
    """Let Ctrl-C end the process at once and without a traceback, until `interruptible`."""
    # There is nothing to clean up yet, or nothing left to clean up. An ignored SIGINT stays ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def interruptible() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again: from now on there may be something to clean up."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(_number: int, _frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
