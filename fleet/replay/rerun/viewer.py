"""Runs Rerun's viewer as a child process that never outlives us."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, Self

from schemas.process.children import OWN_GROUP, wait

VIEWER_HOST: Final = "127.0.0.1"
VIEWER_START_TIMEOUT_S: Final = 30.0
VIEWER_POLL_INTERVAL_S: Final = 0.05

_RERUN_ENVIRONMENT: Final = {"CI": "1", "RUST_LOG": "error"}
"""Without CI, Rerun 0.41 writes analytics to the user's home directory. No other switch prevents it."""


def environment() -> dict[str, str]:
    """Return the environment for processes of Rerun."""
    return {**os.environ, **_RERUN_ENVIRONMENT}


def program() -> Path:
    """Return the path of Rerun's program.

    The `rerun` on PATH is a wrapper. If the wrapper is ended, the viewer runs on.
    """
    import rerun_cli  # type: ignore[import-untyped]  # only a wrapper around the program

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(rerun_cli.__file__).parent / name


def has_display() -> bool:
    """Return True if a window can probably be opened."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class NoViewer(Exception):
    """The viewer did not start. The message gives the reason."""


class Viewer:
    """Rerun's program, bound to loopback. A context manager. The program ends with `close`, or with our process."""

    def __init__(self, *arguments: str, extra: Mapping[str, str] = MappingProxyType({})) -> None:
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - `close` closes it
        command = [
            sys.executable,
            "-m",
            "schemas.process.parent_guard",
            str(program()),
            "--bind",
            VIEWER_HOST,
            *arguments,
        ]
        self._guard = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env={**environment(), **extra},
            process_group=OWN_GROUP,
        )
        assert self._guard.stdout is not None
        self.pid = int(self._guard.stdout.readline() or 0)
        """Process id of Rerun's program, not of the guard."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ended(self) -> int | None:
        """Return the exit code of the viewer, or None while it runs."""
        return self._guard.poll()

    def wait(self, seconds: float | None = None) -> int | None:
        """Wait until the viewer's window is closed.

        Return the exit code, or None if it is still open after `seconds`.
        """
        return wait(self._guard, seconds)

    def wait_until_it_listens(self, port: int) -> None:
        """Wait until the viewer accepts data at this port. Raises NoViewer if it does not."""
        deadline = time.monotonic() + VIEWER_START_TIMEOUT_S
        while True:
            with socket.socket() as probe:
                probe.settimeout(1.0)
                if probe.connect_ex((VIEWER_HOST, port)) == 0:
                    return
            if self.wait(VIEWER_POLL_INTERVAL_S) is not None or time.monotonic() > deadline:
                raise NoViewer(f"Rerun's viewer did not come up: {self.last_error}")

    @property
    def last_error(self) -> str:
        """Return the viewer's last line on stderr."""
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"

    def close(self) -> None:
        """End the viewer if it still runs."""
        for stream in (self._guard.stdin, self._guard.stdout):
            if stream is not None:
                stream.close()
        if self._guard.wait() < 0 and self.pid:
            # The guard was killed and could not end the viewer.
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
        self._stderr.close()


def free_port() -> int:
    """Return a loopback port that is free at this moment."""
    with socket.socket() as probe:
        probe.bind((VIEWER_HOST, 0))
        port: int = probe.getsockname()[1]
        return port
