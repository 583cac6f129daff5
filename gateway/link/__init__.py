"""Byte streams to a car: serial, TCP, Bluetooth LE. `gateway.drivers` gives the bytes their meaning.

`base` has the interface and its errors. `serial`, `tcp` and `ble` implement it, two of them with the buffer of
`buffered_link`; `ble_adapters` has the turns of several gateways at one adapter. `usb` finds the port of a USB device,
`url` accepts a link from the command line. `baud` doubts the baud rate of bytes without a frame.
"""

from gateway.link.base import BadUrl, Busy, CannotOpen, Link, LinkError, LinkLost
from gateway.link.baud import BaudWatch
from gateway.link.url import parse_url
from schemas.links import BleUrl, LinkUrl, SerialUrl, TcpUrl, UsbUrl

__all__ = [
    "BadUrl",
    "BaudWatch",
    "Busy",
    "CannotOpen",
    "Link",
    "LinkError",
    "LinkLost",
    "LinkUrl",
    "open_link",
    "parse_url",
]

OPEN_TIMEOUT_S = 5.0
# A module advertises about once a second, and a scan often misses the first one. The fourth car needs 4 s to connect.
BLE_TIMEOUT_S = 20.0


async def open_link(url: LinkUrl, *, timeout_s: float | None = None, first: bool = False) -> Link:
    """Open the link within this time; raise CannotOpen, whose message says what is wrong and what to do.

    The connects through one Bluetooth adapter take turns. `first`: the car may be moving, so it goes first.
    """
    match url:
        case SerialUrl() | UsbUrl():
            from gateway.link.serial import open_serial

            return await open_serial(url, OPEN_TIMEOUT_S if timeout_s is None else timeout_s)
        case TcpUrl():
            from gateway.link.tcp import open_tcp

            return await open_tcp(url, OPEN_TIMEOUT_S if timeout_s is None else timeout_s)
        case BleUrl():
            from gateway.link.ble import open_ble

            return await open_ble(url, BLE_TIMEOUT_S if timeout_s is None else timeout_s, first=first)
