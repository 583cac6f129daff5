"""The Bluetooth adapters of this computer: which gateway connects through one next, and how many connections it has.

An adapter can make only one connection at a time. BlueZ refuses a second attempt meanwhile (InProgress): without turns,
40 % of the attempts of several gateways failed that way. So the gateways of one user take turns: each adapter has a
lock, a file in the state directory, which is released when its holder ends. A car that may be moving goes first: its
gateway takes a second lock, the lane. While the lane is taken, other gateways do not even try. Only connecting needs a
turn. A stop is a write on an open link, and never waits.
"""

import contextlib
from pathlib import Path
from typing import Final

from gateway.link import bluez
from schemas.process.file_lock import FileLock
from schemas.state_dir import default_directory

TURN_POLL_S: Final = 0.05
"""Interval of the attempts to take a turn."""


class Turn:
    """The turn of one gateway to connect through one adapter. With `first`, its car may be moving."""

    def __init__(self, adapter: str, *, first: bool, directory: Path | None = None) -> None:
        self._first = first
        self._turn = FileLock(_directory(directory) / f"{adapter}.lock")
        self._lane = FileLock(_directory(directory) / f"{adapter}.first.lock")

    def try_take(self) -> bool:
        """Take the turn if it is free. Return True if this gateway has it now."""
        # If several cars may be moving, one of their gateways holds the lane for all. Others take it for a moment only.
        try:
            is_free = self._lane.try_take()
            if not (is_free or self._first):
                return False
            taken = self._turn.try_take()
        except OSError:  # a lock file cannot be made: it is better to connect without a turn than never
            return True
        if taken or not self._first:
            self._lane.release()
        return taken

    def release(self) -> None:
        """Let the next gateway connect, and leave the lane."""
        self._turn.release()
        self._lane.release()


class ConnectionNote:
    """A file that says which device a gateway has connected through which adapter.

    If a gateway is killed, the system keeps its connection. Only this file shows that it belonged to a gateway.
    """

    def __init__(self, adapter: str, address: str, directory: Path | None = None) -> None:
        self.adapter, self.address = adapter, address.upper()
        self._path = _directory(directory) / f"{adapter}.{self.address.replace(':', '_')}.connected"

    @classmethod
    def all_of(cls, adapter: str, directory: Path | None = None) -> "list[ConnectionNote]":
        """Return the notes of an adapter."""
        found = sorted(_directory(directory).glob(f"{adapter}.*.connected"))
        return [cls(adapter, path.name.split(".")[1].replace("_", ":"), directory) for path in found]

    def write(self) -> None:
        """Write the file, if that is possible."""
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.touch()

    def remove(self) -> None:
        """Remove the file."""
        with contextlib.suppress(OSError):
            self._path.unlink()

    async def disconnect(self) -> None:
        """End the connection of a gateway that has ended."""
        await bluez.disconnect(self.adapter, self.address)
        self.remove()


def _directory(directory: Path | None) -> Path:
    return (default_directory() if directory is None else directory) / "bluetooth"
