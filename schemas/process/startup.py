"""What a process of ours does before its imports, which take a tenth of a second and more."""

import os
import signal
from types import FrameType
from typing import Final

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as shells have it: 128 + SIGINT."""


def begin() -> None:
    """Let Ctrl-C end the process at once and without a traceback, until `interruptible`.

    Nothing is open yet that would have to be closed. A SIGINT that came ignored stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def interruptible() -> None:
    """From now on Ctrl-C is a KeyboardInterrupt again: there may be something to clean up."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(_number: int, _frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
