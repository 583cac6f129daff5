"""Byte streams to a car: serial, TCP, Bluetooth LE. `gateway.drivers` gives the bytes their meaning.

`base` has the interfaces, `errors` what goes wrong. `serial`, `tcp` and `ble` implement them, two of them with the
buffer of `buffered_link`; `ble_adapters` has the turns of several gateways at one adapter. `usb` finds the port of a
USB device, `serial_ports` and `ble_devices` list what is there, `url` accepts a link from the command line. `baud`
doubts the baud rate of bytes without a frame.

A kind of link is a URL in `schemas.links`, and a module with its `KIND` here. The two meet by the scheme.
"""

from importlib import import_module
from typing import Any

from gateway.link.base import Device, Link, LinkKind
from gateway.link.baud import BaudWatch
from gateway.link.link_errors import BadUrl, Busy, CannotList, CannotOpen, LinkError, LinkLost
from gateway.link.url import parse_url
from schemas.links import LinkUrl

__all__ = [
    "BadUrl",
    "BaudWatch",
    "Busy",
    "CannotList",
    "CannotOpen",
    "Device",
    "Link",
    "LinkError",
    "LinkLost",
    "LinkUrl",
    "kind_of",
    "open_link",
    "parse_url",
]


def kind_of(scheme: str) -> LinkKind[Any]:
    """Return what opens and lists the links of this scheme. Raises ImportError if a module that it needs is missing.

    Its module is imported when it is needed, so a gateway starts faster.
    """
    kind: LinkKind[Any] = import_module(f"gateway.link.{scheme}").KIND
    return kind


async def open_link(url: LinkUrl, *, timeout_s: float | None = None, first: bool = False) -> Link:
    """Open the link within this time. The message of CannotOpen tells what is wrong and what to do.

    Connections through one Bluetooth adapter take turns. With `first`, the car may be moving, so it goes first.
    """
    kind = kind_of(url.scheme)
    return await kind.open(url, kind.open_timeout_s if timeout_s is None else timeout_s, first=first)
