"""Notices a panic in a library that is written in Rust: its threads may end while the process still looks alive.

Rust writes the message of a panic to stderr, and Python gets no other sign of it. So stderr goes through a pipe that is
read here, and from there to where it went before.
"""

import os
import sys
import threading
from typing import Final, Self

MESSAGE: Final = b"panicked at"
"""Part of every message of a panic (Rust's standard panic hook)."""
_MAX_READ_BYTES: Final = 65_536


class PanicWatch:
    """Passes stderr on, and sets `panicked` after the message of a panic. Use it as a context, in the main module."""

    def __init__(self, descriptor: int = 2) -> None:
        self._descriptor = descriptor
        self.panicked = threading.Event()

    def __enter__(self) -> Self:
        sys.stderr.flush()
        self._real = os.dup(self._descriptor)
        reads, writes = os.pipe()
        os.dup2(writes, self._descriptor)
        os.close(writes)
        self._reads = reads
        self._thread = threading.Thread(target=self._pass_on, name="stderr", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.restore()
        self._thread.join()
        os.close(self._reads)
        os.close(self._real)

    def restore(self) -> None:
        """Let stderr go where it went before, also for a program that replaces this one by `exec`."""
        sys.stderr.flush()
        os.dup2(self._real, self._descriptor)  # the pipe has no other writer, so it ends

    def _pass_on(self) -> None:
        rest = b""
        while data := os.read(self._reads, _MAX_READ_BYTES):
            rest = rest[-len(MESSAGE) :] + data
            if MESSAGE in rest:
                self.panicked.set()
            while data:
                data = data[os.write(self._real, data) :]
