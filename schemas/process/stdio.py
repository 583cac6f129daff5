"""Standard streams that a process was started without, or that cannot be written any more."""

import os
import sys
from typing import IO


def complete() -> None:
    """Put something where stdin, stdout or stderr is closed: a link that got its number would be taken for it.

    Reading finds the end, writing to stdout fails as on a full disk and is told like that, stderr goes nowhere.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number is given, which is this one.
            opened = os.open(os.devnull, os.O_WRONLY if number == 2 else os.O_RDONLY)
            os.set_inheritable(opened, True)  # noqa: FBT003 - it takes no keyword
    if sys.__stdout__ is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - a descriptor, for as long as the process
    if sys.__stderr__ is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 - likewise


def silence(stream: IO[str]) -> None:
    """After a write has failed: what is still held would be tried again at the end, with a complaint."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
