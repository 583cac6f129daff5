"""Signals of the processes that tests start, whatever the one who runs the tests ignores (`nohup`, a script's `&`)."""

import os
import signal
from typing import Final

_NUMBERS: Final = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
"""The signals by which tests end what they start."""


def give_default_signals() -> None:
    """Let each process that is started from now on get the default of the signals that end it. Main thread only.

    SIGINT becomes what it is at a terminal here, too. The others stay without effect on this process.
    """
    # An ignored signal stays ignored in every child. A handler does not: at its exec, a child gets the default.
    # A worker of pytest-xdist is such a child. It ends with its controller, so no closed terminal may end it before.
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    for number in _NUMBERS:
        if (is_worker and number is signal.SIGHUP) or signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number is signal.SIGINT else _no_effect)


def _no_effect(*_: object) -> None:
    """Take a signal that who runs the tests wants to be ignored."""
