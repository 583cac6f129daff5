"""Ends child processes."""

import contextlib
import subprocess
from asyncio.subprocess import Process
from typing import Any


def kill(process: Process) -> None:
    """Kill a process of asyncio. Do nothing if it has ended."""
    with contextlib.suppress(ProcessLookupError):
        process.kill()


def end(process: "subprocess.Popen[Any]", grace_s: float) -> bool:
    """End a process, and kill it after `grace_s`. Return False if it had to be killed."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(grace_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False
    return True
