"""The addresses and names of this computer in its networks."""

import ipaddress
import re
import socket
from typing import Final

import ifaddr

_HOST_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?(\.[A-Za-z0-9-]{1,63})*")


def own_addresses() -> list[str]:
    """Return the IPv4 addresses of this computer in its networks. The address of the default route comes first."""
    listed = [str(each.ip) for adapter in ifaddr.get_adapters() for each in adapter.ips if each.is_IPv4]
    found = [each for each in listed if not ipaddress.ip_address(each).is_loopback]
    first = _default_address()
    return sorted(dict.fromkeys(found), key=lambda address: (address != first, address))


def _default_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation; connecting UDP sends nothing
        except OSError:
            return ""
        return str(probe.getsockname()[0])


def own_names() -> list[str]:
    """Return the host names of this computer."""
    name = socket.gethostname().lower()
    return [name, f"{name.partition('.')[0]}.local"] if _HOST_NAME.fullmatch(name) else []
