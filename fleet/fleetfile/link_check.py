"""Checks the links in a fleet file. Opens only those whose opening cannot move or reset a car, or end its program.

Opening a serial port resets an Arduino. Closing a connection to a Raspberry Pi car ends the car's program while the
motors keep running (docs/reference/protocol.md#hazards-of-raspberry-pi-programs), so only its host is checked. For a
car with a gateway, the state of the gateway counts.
"""

import errno
import os
import socket
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from fleet.fleet_links import SimLink, may_be_same, parse_fleet_link
from fleet.fleetfile.fleet_file import FleetCar
from gateway import drivers
from schemas.links import UsbUrl
from schemas.process import serial_port_users
from schemas.process.serial_port_permission import permission_hint
from schemas.process.usb_bus import CH340, explain_missing_port
from schemas.words import LinkState

if TYPE_CHECKING:
    from serial.tools.list_ports_common import ListPortInfo

HOST_TIMEOUT_S: Final = 3.0
"""Timeout for the reply of a host, for each of its addresses."""
CLOSED_PORT: Final = 9
"""A TCP port at which hardly any host listens (discard). A reachable host without a firewall refuses a connection to it
at once."""


class LinkCheck(Struct, frozen=True):
    """The result of the check of one car's link."""

    car: str
    link: str
    ok: bool
    words: str


def check_link(car: FleetCar, running_links: Mapping[str, tuple[str, str, str]]) -> LinkCheck:
    """Check a car's link, which may take HOST_TIMEOUT_S and more for a host that does not answer.

    `running_links`: state, reason and URL, by the car of each gateway.
    """
    if car.name in running_links:
        state, reason, url = running_links[car.name]
        if url and not _is_same(url, car.link):
            words = f"a running gateway of this name has another link: {url}"
            return LinkCheck(car.name, car.link, ok=False, words=words)
        ok = state in (LinkState.ONLINE, LinkState.QUIET)
        words = f"its gateway runs, the link is {state}" + (f": {reason}" if reason and not ok else "")
        return LinkCheck(car.name, car.link, ok, words)
    link = parse_fleet_link(car.link)
    ok, words = (True, "`fleet up` simulates it") if isinstance(link, SimLink) else link.check(_Look(car.platform))
    return LinkCheck(car.name, car.link, ok, words)


def _is_same(url: str, link: str) -> bool:
    """Return True if a gateway with this URL may serve the car with this link. A simulated car's URL is temporary."""
    expected = parse_fleet_link(link)
    return isinstance(expected, SimLink) or may_be_same(parse_fleet_link(url), expected)


class _Look:
    """Looks at the device or host that the link of a car of this platform names."""

    def __init__(self, platform: str) -> None:
        self._has_bridge = not any(profile.has_network for profile in drivers.profiles_of(platform))

    def device(self, path: str) -> tuple[bool, str]:
        return check_device(path)

    def usb(self, url: UsbUrl) -> tuple[bool, str]:
        return _check_usb(url)

    def host(self, host: str, port: int) -> tuple[bool, str]:
        return _check_host(host, port, bridge=self._has_bridge)


def check_device(path: str) -> tuple[bool, str]:
    """Return whether a serial port exists, may be opened and is free, with a text. Nothing is opened."""
    if os.name != "posix":
        is_listed = path.upper() in (str(port.device).upper() for port in _list_ports())
        return is_listed, "the port is there; not opened" if is_listed else "there is no such port: plug the car in"
    try:
        file_stat = Path(path).stat()
    except OSError as error:
        if error.errno == errno.ENOENT and (missing := explain_missing_port()):
            return False, f"there is no such device. {missing}"
        if error.errno == errno.ENOENT:
            return False, "there is no such device: plug the car in, switch it on, or bind it again (fleet bind)"
        return False, f"cannot be checked: {error.strerror}"
    if not stat.S_ISCHR(file_stat.st_mode):
        return False, "is not a serial port"
    if not os.access(path, os.R_OK | os.W_OK):
        return False, f"no permission. {permission_hint(path)}"
    holder = serial_port_users.find_holder(file_stat)
    if holder is not None:
        return False, f"in use by {holder}. Stop that program first."
    free = "free" if serial_port_users.LOCKS.exists() else "whether it is free is not known here"
    users = ", ".join(serial_port_users.find_users(path))
    shared = f", but {users} has it open and may take its bytes: stop that" if users else ""
    return True, f"there, permitted, {free}{shared}; not opened, because that can reset a car"


def _list_ports() -> "list[ListPortInfo]":
    from serial.tools import list_ports

    return list(list_ports.comports())


def _check_usb(link: UsbUrl) -> tuple[bool, str]:
    matching = [str(port.device) for port in _list_ports() if link.fits(port.vid, port.pid, port.serial_number)]
    if not matching and link.fits(*CH340, None) and (missing := explain_missing_port()):
        return False, missing
    if not matching:
        return False, "no such USB device is plugged in: plug the car in, or bind it again (fleet bind)"
    if len(matching) > 1:
        return False, f"{len(matching)} devices fit ({', '.join(sorted(matching))}): add a serial= that only one has"
    ok, words = check_device(matching[0])
    return ok, f"{matching[0]}: {words}"


def _check_host(host: str, port: int, *, bridge: bool) -> tuple[bool, str]:
    try:
        with socket.create_connection((host, port if bridge else CLOSED_PORT), timeout=HOST_TIMEOUT_S):
            pass
    except ConnectionRefusedError:
        if bridge:
            return False, f"{host} is there, and nothing listens on port {port}: start the car's bridge"
    except TimeoutError:
        return False, f"no answer from {host} within {HOST_TIMEOUT_S:g} s: switch the car on, join its network"
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that DNS cannot express
        words = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return False, f"{host}: {words}: switch the car on, join its network"
    if bridge:
        return True, "its bridge accepts connections"
    return True, f"{host} is there; port {port} was not tried, as some cars end with their first connection"
