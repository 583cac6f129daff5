"""The interfaces of every link (read, write, close) and of every kind of link (open, list)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Generic, TypeVar

from gateway.link.serial_ports import SerialPort
from schemas.links import LinkUrl

Url = TypeVar("Url", bound=LinkUrl)

CLOSE_S: Final = 1.0
"""Timeout for closing a port or a connection (Bluetooth: 4 s). After it, `close` abandons or cuts the link."""


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
        """Wait for bytes and return them as they arrived, at least one. Raises LinkLost when the link ends."""

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Send these bytes, with nothing between them. Raises LinkLost if the link does not accept them.

        Serial and TCP: in one write of their own, without waiting. Bluetooth: in pieces, within a second.
        """

    @abstractmethod
    async def close(self) -> None:
        """Release the port within CLOSE_S; pending reads and writes raise LinkLost. Never raise; idempotent."""


class Device(ABC):
    """A device that advertises itself, and may be a car's."""

    url: str

    @abstractmethod
    def fields(self) -> dict[str, Any]:
        """Return what is known of it, for `--json`: at least url, name, rssi, and uart, which only a car has."""

    @property
    @abstractmethod
    def heading(self) -> tuple[str, str]:
        """Its address, and what else is known of it, for a person."""

    @property
    @abstractmethod
    def likely(self) -> str:
        """What makes it a car's. Empty for any other device."""


class LinkKind(ABC, Generic[Url]):
    """What opens and lists the links of one scheme. `schemas.links` has their URLs."""

    open_timeout_s: ClassVar[float] = 5.0

    @abstractmethod
    async def open(self, url: Url, timeout_s: float, *, first: bool) -> Link:
        """Open the link, or raise CannotOpen. With `first`, do so before cars that wait for the same adapter."""

    def ports(self) -> Sequence[SerialPort]:
        """Return the ports that can be listened to without harm. Raises CannotOpen if the system does not list them."""
        return ()

    async def devices(self, seconds: float) -> Sequence[Device]:  # noqa: ARG002 - few kinds advertise
        """Return the devices that advertise in this time, likely cars first. Raises CannotList if it cannot look."""
        return ()
