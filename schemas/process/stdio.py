"""Repairs closed or broken standard streams, and makes foreign text printable."""

import os
import sys
from typing import IO


def complete() -> None:
    """Open /dev/null on closed standard descriptors, so that no port or socket gets descriptor 0, 1 or 2."""
    # Then reading stdin returns end of file, writing to stdout fails as on a full disk, and stderr is discarded.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The system returns the lowest free number, which is this one.
            opened = os.open(os.devnull, os.O_WRONLY if number == 2 else os.O_RDONLY)
            os.set_inheritable(opened, True)  # noqa: FBT003 - it takes no keyword
    if sys.__stdout__ is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - a descriptor, for as long as the process
    if sys.__stderr__ is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 - stays open


def silence(stream: IO[str]) -> None:
    """Redirect a broken stream to /dev/null, so that the interpreter does not flush it at exit and print an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def silence_broken(error: OSError, program: str) -> int:
    """Silence a broken stdout. Print why, unless the reader has closed the pipe. Return the exit code."""
    silence(sys.stdout)
    if not isinstance(error, BrokenPipeError):
        sys.stderr.write(f"{program}: the output cannot be written: {error.strerror}\n")
    return 1


def shows_colors(stream: IO[str]) -> bool:
    """Return False for a pipe, with NO_COLOR, and for a terminal without colors."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def printable(text: str | None, instead: str = "") -> str:
    """Return a foreign text without control characters, fit for one line of a terminal or a file."""
    return "".join(each if each.isprintable() else instead for each in text or "")
