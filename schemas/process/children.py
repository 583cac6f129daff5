"""Starts, waits for and ends child processes."""

import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, Final

if TYPE_CHECKING:  # most processes have no loop
    from asyncio.subprocess import Process

OWN_GROUP: Final = 0 if os.name == "posix" else None
"""The `process_group` of a child that we end ourselves: Ctrl-C at the terminal then reaches only us."""


def start_detached(command: Sequence[str], *, output: int | IO[Any] = subprocess.DEVNULL) -> "subprocess.Popen[str]":
    """Start a process that outlives this one and its terminal. Call `leave` before this one ends.

    `output` is where its stdout and stderr go.
    """
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=os.name == "posix",  # closing the terminal must not end the process
        creationflags=getattr(subprocess, "DETACHED_PROCESS", 0) | getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    )


def leave(process: "subprocess.Popen[Any]") -> None:
    """Let a process run on. Without this, the interpreter warns that nobody waited for it."""
    process.returncode = process.poll() or 0


def wait(process: "subprocess.Popen[Any]", timeout_s: float | None) -> int | None:
    """Wait until a process has ended. Return its exit code, or None if it still runs after `timeout_s`.

    A timeout of None means no limit.
    """
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def end(process: "subprocess.Popen[Any]", grace_s: float) -> bool:
    """End a process, and kill it after `grace_s`. Return False if it had to be killed."""
    process.terminate()
    if wait(process, grace_s) is not None:
        return True
    process.kill()
    process.wait()
    return False


def kill(process: "Process") -> None:
    """Kill a process of asyncio. Do nothing if it has ended."""
    with suppress(ProcessLookupError):
        process.kill()
