"""The interfaces of every link (read, write, close) and of every kind of link (open, list)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from schemas.links import LinkUrl

if TYPE_CHECKING:
    from gateway.link.serial_port_list import SerialPort

Url = TypeVar("Url", bound=LinkUrl)

CLOSE_S: Final = 1.0
"""Timeout for closing a port or a connection (Bluetooth: 4 s). After that, `close` abandons or cuts the link."""


class Link(ABC):
    """Bytes to and from one car."""

    @property
    def trouble(self) -> str:
        """The trouble of the open link as one line for a person: what, where, what to do. Empty if there is none."""
        return ""

    def look_for_trouble(self) -> None:
        """Look in the background for the reason why bytes are damaged or missing. `trouble` then has the result."""
        return

    @abstractmethod
    async def read(self) -> bytes:
        """Wait for at least one byte, and return the bytes as they arrived. Raises LinkLost when the link ends."""

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Send these bytes, with nothing between them. Raises LinkLost if the link does not accept them.

        Serial and TCP send them in a single write, without waiting (serial on Windows: up to 0.25 s). Bluetooth sends
        them in pieces, within a second.
        """

    @abstractmethod
    async def close(self) -> None:
        """Release the port within CLOSE_S (Bluetooth: 4 s). It may be called again.

        Pending reads and writes raise LinkLost.
        """


class Device(ABC):
    """A device that advertises itself, and may belong to a car."""

    url: str

    @abstractmethod
    def fields(self) -> dict[str, Any]:
        """Return the known facts for `--json`: at least url, name, rssi, and uart, which only cars' devices have."""

    @property
    @abstractmethod
    def heading(self) -> tuple[str, str]:
        """The address of the device, and a text with the other known facts."""

    @property
    @abstractmethod
    def likely(self) -> str:
        """Why the device probably belongs to a car. Empty for any other device."""


class LinkKind(ABC, Generic[Url]):
    """Opens and lists the links of one scheme. `schemas.links` has their URLs."""

    open_timeout_s: ClassVar[float] = 5.0

    @abstractmethod
    async def open(self, url: Url, timeout_s: float, *, first: bool) -> Link:
        """Open the link, or raise CannotOpen. With `first`, go before other cars that wait for the same adapter."""

    def ports(self) -> "Sequence[SerialPort]":
        """Return the ports to which one can listen without harm. Raises CannotOpen if the system does not list them."""
        return ()

    async def devices(self, seconds: float) -> Sequence[Device]:  # noqa: ARG002 - few kinds advertise
        """Return the devices that advertise within this time, likely cars first. Raises CannotList."""
        return ()
