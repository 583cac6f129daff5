"""What a fleet file may give as a link, and which links are one and the same port. Opens and asks nothing.

The words are those of `gateway run --link`, and `sim`, a car that `fleet up` simulates. A test holds the two together,
since nothing of fleet imports gateway.link.
"""

import ipaddress
import os.path
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import Final
from urllib.parse import parse_qs, unquote, urlsplit

ALLOWED: Final = (
    "allowed are /dev/ttyUSB0 or COM3 (also as serial:///dev/ttyUSB0?baud=9600), "
    "serial://?vid=1a86&pid=7523&serial=ABC (one of the three is enough), tcp://HOST:PORT, "
    "ble://AA:BB:CC:DD:EE:FF (macOS: a UUID), ble://name=BT04 (`gateway scan` shows them), or sim"
)
_WINDOWS_PORT: Final = re.compile(r"COM\d{1,3}", re.IGNORECASE)
_USB_ID: Final = re.compile(r"(?:0[xX])?([0-9a-fA-F]{4})")
_USB_FIELDS: Final = ("vid", "pid", "serial")
_BAUD: Final = re.compile(r"\d{1,9}", re.ASCII)
_BAUDS: Final = range(300, 4_000_001)
_BLE_ADDRESS: Final = re.compile(r"[0-9A-F]{2}(:[0-9A-F]{2}){5}|[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}")
_BLE_NAME_BYTES: Final = 248


class LinkKind(StrEnum):
    """How a car is reached."""

    DEVICE = "device"
    USB = "usb"
    TCP = "tcp"
    BLE = "ble"
    SIMULATED = "sim"


Port = tuple[LinkKind, str, frozenset[tuple[str, str]]]
"""Equal for two links to one port: the kind, the device or host behind all its names, and the ids."""


class BadLink(ValueError):
    """Text that is no link; its words say why not."""


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A link, taken apart. where: a device path, a host, a Bluetooth address in capitals, or empty.

    ids: what a USB device says of itself, or a Bluetooth device's name; of a TCP link its port.
    """

    kind: LinkKind
    where: str = ""
    ids: frozenset[tuple[str, str]] = frozenset()

    @property
    def port(self) -> Port | None:
        """Return the key of the port that this link names; None for a simulated car, which has no port."""
        match self.kind:
            case LinkKind.SIMULATED:
                return None
            case LinkKind.DEVICE:
                return (self.kind, _real(self.where), self.ids)
            case _:
                return (self.kind, _host(self.where), self.ids)

    def descriptions(self) -> Iterator[Port]:
        """Yield the keys of all links that may name this port by saying less: fewer ids of one USB device."""
        port = self.port
        if port is None:
            return
        kind, where, _ = port
        if kind is not LinkKind.USB:
            yield port
            return
        for count in range(1, len(self.ids) + 1):
            for fewer in combinations(sorted(self.ids), count):
                yield (kind, where, frozenset(fewer))

    def may_be(self, other: "LinkUrl") -> bool:
        """Return True if both can be one port: one device behind two paths, or one USB device described twice."""
        return self.port in set(other.descriptions()) or other.port in set(self.descriptions())


def shared_ports(links: Mapping[str, LinkUrl]) -> Iterator[tuple[str, str]]:
    """Yield (first car, second car) for each car whose link may name the port of a car before it.

    Each car is compared with what is known of all before it, not with each of them: 5,000 cars make 12 million pairs.
    """
    order = {car: index for index, car in enumerate(links)}
    by_port: dict[Port, str] = {}
    by_description: dict[Port, str] = {}
    for car, link in links.items():
        port = link.port
        if port is None:
            continue
        described = list(link.descriptions())
        # Two USB links may be one device if one of the two gives all ids of the other.
        before = [by_port[each] for each in described if each in by_port]
        before += [by_description[port]] if port in by_description else []
        if before:
            yield min(before, key=order.__getitem__), car
        by_port.setdefault(port, car)
        for each in described:
            by_description.setdefault(each, car)


def parse_link(text: str) -> LinkUrl:
    """The link that a text names; raises BadLink."""
    if not text.isprintable():
        raise BadLink("it has characters that cannot be printed")
    if text == LinkKind.SIMULATED:
        return LinkUrl(LinkKind.SIMULATED)
    if text.startswith("/") or _WINDOWS_PORT.fullmatch(text):
        return LinkUrl(LinkKind.DEVICE, text)
    if text[:6].lower() == "ble://":
        return _ble(text[6:])
    try:
        parts = urlsplit(text)
        port = parts.port if parts.scheme == "tcp" else None
    except ValueError as error:
        raise BadLink(str(error)) from None
    if parts.scheme == "serial":
        if parts.fragment:
            raise BadLink("a # is written %23, and that only in a serial number")
        return _serial(parts.netloc, parts.path, parts.query)
    if parts.scheme == "tcp":
        if not parts.hostname or not port:
            raise BadLink("a host and a port from 1 to 65535 are needed")
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            raise BadLink("nothing may follow the port")
        return LinkUrl(LinkKind.TCP, parts.hostname, frozenset({("port", str(port))}))
    raise BadLink(f"{parts.scheme}:// is no kind of link" if parts.scheme else "it is neither a URL nor a device path")


def _serial(netloc: str, path: str, query: str) -> LinkUrl:
    fields = parse_qs(query.replace("+", "%2B"), keep_blank_values=True)
    if unknown := sorted(fields.keys() - {"baud", *_USB_FIELDS}):
        raise BadLink(f"{', '.join(unknown)} is no option of a serial link")
    if twice := sorted(name for name, values in fields.items() if len(values) > 1):
        raise BadLink(f"{', '.join(twice)} is given twice")
    given = {name: values[0] for name, values in fields.items()}
    baud = given.pop("baud", "9600")
    if not _BAUD.fullmatch(baud) or int(baud) not in _BAUDS:
        raise BadLink(f"baud={baud} is not from {_BAUDS.start} to {_BAUDS.stop - 1}")
    if path.strip("/") or netloc:
        if netloc and path.strip("/"):
            raise BadLink("three slashes come before a device path")
        if netloc and not _WINDOWS_PORT.fullmatch(netloc):
            raise BadLink("it names no device")
        if given:
            raise BadLink(f"it names a device path, and {', '.join(sorted(given))} too: one of the two")
        return LinkUrl(LinkKind.DEVICE, path or netloc)
    if not given:
        raise BadLink("it names no device")
    if given.get("serial") == "":
        raise BadLink("serial= is empty")
    for name in ("vid", "pid"):
        if name in given:
            found = _USB_ID.fullmatch(given[name])
            if found is None:
                raise BadLink(f"{name}={given[name]} is not four hexadecimal digits")
            given[name] = found[1].lower()
    return LinkUrl(LinkKind.USB, "", frozenset(given.items()))


def _ble(rest: str) -> LinkUrl:
    if rest.startswith("name="):
        name = unquote(rest[5:])
        if not name or not name.isprintable() or len(name.encode()) > _BLE_NAME_BYTES:
            raise BadLink(f"a name has 1 to {_BLE_NAME_BYTES} bytes, and can be printed")
        return LinkUrl(LinkKind.BLE, "", frozenset({("name", name)}))
    if _BLE_ADDRESS.fullmatch(rest.upper()) is None:
        raise BadLink("it names no Bluetooth address, and no name=")
    return LinkUrl(LinkKind.BLE, rest.upper())


def _real(path: str) -> str:
    """The device behind a link such as those in /dev/serial/by-id; Windows knows COM3 and com3 as one."""
    return path.upper() if _WINDOWS_PORT.fullmatch(path) else os.path.realpath(path)


def _host(host: str) -> str:
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower().rstrip(".")
