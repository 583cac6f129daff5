"""What every link is: read, write and close, and the errors that they raise."""

from abc import ABC, abstractmethod
from typing import Final

CLOSE_S: Final = 1.0
"""How long `close` waits for a port or a peer (Bluetooth: 4 s); one that is not done then is left to itself, or cut."""


class LinkError(Exception):
    """A link cannot be had, or is gone. The text is one line for a person: what, where, what to do."""


class BadUrl(LinkError):
    """A URL that names no link: wrong use."""


class CannotOpen(LinkError):
    """The link was not opened; nothing was sent."""


class Busy(CannotOpen):
    """Another program has the port."""


class LinkLost(LinkError):
    """The link is gone. A write that raises this may have sent all, some or none of its bytes."""


class Link(ABC):
    """Bytes to and from one car."""

    @abstractmethod
    async def read(self) -> bytes:
        """The next bytes as they came, at least one; raises LinkLost when there will be no more."""

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Hand over these bytes whole, with nothing between them; raises LinkLost.

        Serial and TCP: in one write of their own, and without waiting. Bluetooth: in pieces, and within a second.
        """

    @abstractmethod
    async def close(self) -> None:
        """Let go of the port within CLOSE_S; what is pending raises LinkLost. Never raises; may be called again."""
