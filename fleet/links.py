"""The links of a fleet file: those of `gateway run --link`, and `sim`. Finds links that name the same port."""

import ipaddress
import os.path
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

from schemas.links import WINDOWS_PORT, BleUrl, LinkUrl, SerialUrl, TcpUrl, UsbUrl, parse_link

LINK_SIM: Final = "sim"
"""The link of a car that `fleet up` simulates."""


@dataclass(frozen=True, slots=True)
class SimLink:
    """The link of a simulated car, which has no port."""


FleetLink = LinkUrl | SimLink
Port = tuple[str, str, frozenset[tuple[str, str]]]
"""Equal for two links to one port: the kind of link, the device or host behind all its names, and the ids."""


def parse_fleet_link(text: str) -> FleetLink:
    """Return the link with this text; raise BadLink."""
    return SimLink() if text == LINK_SIM else parse_link(text)


def port_of(link: FleetLink) -> Port | None:
    """Return the key of the port that a link names. None for a simulated car."""
    match link:
        case SimLink():
            return None
        case SerialUrl(path=path):
            return ("device", _device(path), frozenset())
        case TcpUrl(host=host, port=port):
            return ("tcp", _host(host), frozenset({("port", str(port))}))
        case BleUrl(address=address, name=name):
            return ("ble", address or "", frozenset() if name is None else frozenset({("name", name)}))
        case UsbUrl(vid=vid, pid=pid, serial=serial):
            ids = (("vid", vid), ("pid", pid), ("serial", serial))
            return ("usb", "", frozenset((name, str(value)) for name, value in ids if value is not None))


def possible_ports(link: FleetLink) -> Iterator[Port]:
    """Yield the keys of all links that may name the port of this one: for a USB device, also with fewer ids."""
    port = port_of(link)
    if port is None:
        return
    if not isinstance(link, UsbUrl):
        yield port
        return
    kind, where, ids = port
    for count in range(1, len(ids) + 1):
        for fewer in combinations(sorted(ids), count):
            yield (kind, where, frozenset(fewer))


def may_be_same(one: FleetLink, other: FleetLink) -> bool:
    """Return True if both can be one port: one device behind two paths, or one USB device described twice."""
    return port_of(one) in set(possible_ports(other)) or port_of(other) in set(possible_ports(one))


def shared_ports(links: Mapping[str, FleetLink]) -> Iterator[tuple[str, str]]:
    """Yield (first car, second car) for each car whose link may name the port of an earlier car."""
    # Look-ups instead of pairs: 5,000 cars would make 12 million pairs.
    order = {car: index for index, car in enumerate(links)}
    by_port: dict[Port, str] = {}
    by_possible: dict[Port, str] = {}
    for car, link in links.items():
        port = port_of(link)
        if port is None:
            continue
        possible = list(possible_ports(link))
        # Two USB links may be one device if one of the two gives all ids of the other.
        earlier = [by_port[each] for each in possible if each in by_port]
        earlier += [by_possible[port]] if port in by_possible else []
        if earlier:
            yield min(earlier, key=order.__getitem__), car
        by_port.setdefault(port, car)
        for each in possible:
            by_possible.setdefault(each, car)


def _device(path: str) -> str:
    # Resolve symlinks such as those in /dev/serial/by-id. On Windows, COM3 and com3 are one port.
    return path.upper() if WINDOWS_PORT.fullmatch(path) else os.path.realpath(path)


def _host(host: str) -> str:
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower().rstrip(".")
