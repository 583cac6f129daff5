"""The interface of every link (read, write, close) and its errors."""

import asyncio
from abc import ABC, abstractmethod
from typing import Final

CLOSE_S: Final = 1.0
"""Timeout for closing a port or a connection (Bluetooth: 4 s). After it, `close` abandons or cuts the link."""
# Over a minute of a car's 960 bytes/s.
MAX_BUFFERED_BYTES: Final = 64 * 1024
"""Maximum of unread bytes. Above it, TCP stops reading the socket; Bluetooth, without flow control, ends the link."""


class LinkError(Exception):
    """A link cannot be opened, or is lost. The message is one line for a person: what, where, what to do."""


class BadUrl(LinkError):
    """A URL that is no link: wrong use."""


class CannotOpen(LinkError):
    """The link was not opened. Nothing was sent."""


class Busy(CannotOpen):
    """Another program has the port."""


class LinkLost(LinkError):
    """The link is lost. A write that raises this may have sent all, some or none of its bytes."""


class Link(ABC):
    """Bytes to and from one car."""

    @abstractmethod
    async def read(self) -> bytes:
        """Return the next bytes as they arrived, at least one; raise LinkLost at the end."""

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Send these bytes, with nothing between them; raise LinkLost.

        Serial and TCP: in one write of their own, without waiting. Bluetooth: in pieces, within a second.
        """

    @abstractmethod
    async def close(self) -> None:
        """Release the port within CLOSE_S; pending reads and writes raise LinkLost. Never raise; idempotent."""


class BufferedLink(Link):
    """A link whose callbacks buffer the bytes for `read`."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._came = asyncio.Event()
        """Set if there are bytes, or if the link is lost."""
        self._lost: str | None = None
        """Why the link is lost; None if it is not."""

    async def read(self) -> bytes:
        """Return the next bytes as they arrived; raise LinkLost."""
        while not self._data:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        data = bytes(self._data)
        self._data.clear()
        return data
