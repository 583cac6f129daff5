"""Byte streams to a car: serial, TCP, Bluetooth LE. `gateway.drivers` gives the bytes their meaning.

`base` has the interfaces, which `serial`, `tcp` and `ble` implement, `link_exceptions` the exceptions. `tcp` and `ble`
use the buffer of `buffered_link`. `ble_adapter_turns` lets several gateways take turns at one Bluetooth adapter.
`usb` finds the port of a USB device, `serial_port_list` and `ble_devices` list ports and devices, `url` parses a link
of the command line. `baud` finds out whether the baud rate may be wrong.

Each kind of link has a class of URLs in `schemas.links`, and here a module that is named like the scheme and has a
`KIND`.
"""

from importlib import import_module
from typing import Any

from gateway.link.base import Device, Link, LinkKind
from gateway.link.link_exceptions import BadUrl, Busy, CannotList, CannotOpen, LinkError, LinkLost
from gateway.link.url import parse_url
from schemas.links import LinkUrl

__all__ = [
    "BadUrl",
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
    """Return the kind of link with this scheme. Raises ImportError if a package that it needs is missing.

    Its module is imported only now, so that a gateway starts faster.
    """
    kind: LinkKind[Any] = import_module(f"gateway.link.{scheme}").KIND
    return kind


async def open_link(url: LinkUrl, *, timeout_s: float | None = None, first: bool = False) -> Link:
    """Open the link. Raises CannotOpen, with a message that says what is wrong and what to do, or ImportError.

    `timeout_s` is for the whole opening, but with Bluetooth only for the search. Connecting has its own timeout.

    Gateways connect one after the other through a Bluetooth adapter. With `first`, this car may be moving, so it goes
    first.
    """
    kind = kind_of(url.scheme)
    return await kind.open(url, kind.open_timeout_s if timeout_s is None else timeout_s, first=first)
