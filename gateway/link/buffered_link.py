"""The base class of links whose callbacks buffer bytes: TCP and Bluetooth."""

# This is not in `base`, because `gateway run` imports `base` before it is on the bus, and importing asyncio takes long.
import asyncio
from typing import Final

from gateway.link.base import Link
from gateway.link.link_exceptions import LinkLost

# Over a minute of a car's 960 bytes/s.
MAX_BUFFERED_BYTES: Final = 64 * 1024
"""Maximum unread bytes. Beyond it, TCP stops reading the socket. Bluetooth has no flow control, and ends the link."""


class BufferedLink(Link):
    """A link whose callbacks buffer the bytes for `read`."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._came = asyncio.Event()
        """Set if there are bytes, or if the link is lost."""
        self._lost: str | None = None
        """Why the link is lost, or None if it is not."""

    async def read(self) -> bytes:
        """Wait for bytes and return them as they arrived. Raises LinkLost if the link ends."""
        while not self._data:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        data = bytes(self._data)
        self._data.clear()
        return data
