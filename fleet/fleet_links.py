"""The links in a fleet file: the links that `gateway run --link` accepts, and `sim`.

Finds links that name the same port.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from msgspec import Struct

from schemas.links import LinkUrl, PortKey, parse_link

LINK_SIM: Final = "sim"
"""The link of a car that `fleet up` simulates."""


class SimLink(Struct, frozen=True):
    """The link of a simulated car, which has no port."""


FleetLink = LinkUrl | SimLink


def parse_fleet_link(text: str) -> FleetLink:
    """Return the link with this text. Raises BadLink if it is not a link."""
    return SimLink() if text == LINK_SIM else parse_link(text)


def may_be_same(one: FleetLink, other: FleetLink) -> bool:
    """Return True if both may be the same port: two paths of one device, or two descriptions of one USB device."""
    if isinstance(one, SimLink) or isinstance(other, SimLink):
        return False
    return one.port_key in other.possible_ports() or other.port_key in one.possible_ports()


def shared_ports(links: Mapping[str, FleetLink]) -> Iterator[tuple[str, str]]:
    """Yield (first car, second car) for each car whose link may name the port of an earlier car."""
    # Look up the ports instead of comparing all pairs, because 5,000 cars have 12 million pairs.
    order = {car: index for index, car in enumerate(links)}
    by_port: dict[PortKey, str] = {}
    by_possible: dict[PortKey, str] = {}
    for car, link in links.items():
        if isinstance(link, SimLink):
            continue
        port, possible = link.port_key, list(link.possible_ports())
        # Two USB links may be one device if one of the two gives all ids of the other.
        earlier = [by_port[each] for each in possible if each in by_port]
        if port in by_possible:
            earlier.append(by_possible[port])
        if earlier:
            yield min(earlier, key=order.__getitem__), car
        by_port.setdefault(port, car)
        for each in possible:
            by_possible.setdefault(each, car)
