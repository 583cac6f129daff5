"""Gives the processes that tests start the usual signals, even if a shell ignores some (`nohup`, a script's `&`)."""

import os
import signal
from typing import Final

_NUMBERS: Final = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
"""The signals by which tests end what they start."""


def give_default_signals() -> None:
    """Let each process that is started from now on get the default of the signals that end it. Main thread only.

    In this process, SIGINT does what it does at a terminal, too. The others stay without effect.
    """
    # An ignored signal stays ignored in every child. A handler does not: at its exec, a child gets the default.
    # A worker of pytest-xdist is such a child. It ends with its controller, so no closed terminal may end it before.
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    for number in _NUMBERS:
        if (is_worker and number is signal.SIGHUP) or signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number is signal.SIGINT else _no_effect)


def _no_effect(*_: object) -> None:
    """Ignore a signal that was ignored before."""
