"""The interface of every link (read, write, close) and its errors."""

from abc import ABC, abstractmethod
from typing import Final

CLOSE_S: Final = 1.0
"""Timeout for closing a port or a connection (Bluetooth: 4 s). After it, `close` abandons or cuts the link."""


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

    @property
    def trouble(self) -> str:
        """What is wrong with the open link, one line for a person: what, where, what to do. Empty if nothing is."""
        return ""

    def look_for_trouble(self) -> None:
        """Find out in the background why bytes are damaged or missing; `trouble` says what was found."""
        return

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
