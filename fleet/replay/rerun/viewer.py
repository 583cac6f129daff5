"""Rerun's program as a process of ours: where it is, what it is started with, and that it never outlives us."""

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

LOOPBACK: Final = "127.0.0.1"
UP_WITHIN_S: Final = 30.0
LOOK_S: Final = 0.05

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


class NoViewer(Exception):
    """The viewer did not come up; its text says why."""


class Viewer:
    """Rerun's program, bound to loopback, gone when it is closed or when we are gone; use it with `with`."""

    def __init__(self, *arguments: str, extra: Mapping[str, str] = MappingProxyType({})) -> None:
        self._words = tempfile.TemporaryFile()  # noqa: SIM115 - `close` closes it
        command = [sys.executable, "-m", "schemas.process.parent_guard", str(program()), "--bind", LOOPBACK, *arguments]
        # In a group of its own: Ctrl-C at the terminal comes to us, and we end it when what is under way is over.
        self._guard = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
            env={**environment(), **extra},
            process_group=0 if os.name == "posix" else None,
        )
        assert self._guard.stdout is not None
        self.pid = int(self._guard.stdout.readline() or 0)
        """Of Rerun's program itself."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ended(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._guard.poll()

    def wait(self, seconds: float | None = None) -> int | None:
        """Wait until its window is closed; the exit code, None if it still runs after `seconds`."""
        try:
            return self._guard.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def wait_until_it_listens(self, port: int) -> None:
        """Return once it takes data at this port; raises NoViewer if it does not."""
        deadline = time.monotonic() + UP_WITHIN_S
        while True:
            with socket.socket() as probe:
                probe.settimeout(1.0)
                if probe.connect_ex((LOOPBACK, port)) == 0:
                    return
            if self.wait(LOOK_S) is not None or time.monotonic() > deadline:
                raise NoViewer(f"Rerun's viewer did not come up: {self.last_words}")

    @property
    def last_words(self) -> str:
        """The last that it said on stderr."""
        self._words.seek(0)
        said = self._words.read().decode(errors="replace").strip().splitlines()
        return said[-1] if said else "it said nothing"

    def close(self) -> None:
        """End it, if it has not ended."""
        for stream in (self._guard.stdin, self._guard.stdout):
            if stream is not None:
                stream.close()
        if self._guard.wait() < 0 and self.pid:
            # The guard was killed from outside, and could not take the viewer with it.
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
        self._words.close()


def free_port() -> int:
    """A port of loopback that nobody uses at this moment."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port
