"""Whether the links of a fleet file are there: looked at, never opened where that could move, reset or end anything.

A serial port is not opened: that resets an Arduino. A Raspberry Pi car's TCP port is not connected to: its program ends
when the connection does, and the motors stay as they were; its host is asked instead. A car that a gateway serves is
left to it. See docs/reference/protocol.md#hazards-of-raspberry-pi-programs.
"""

import errno
import os
import re
import socket
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from fleet.fleetfile.fleet_file import FleetCar
from fleet.links import LinkKind, LinkUrl, parse_link
from gateway.protocol.platforms import Platform

PATIENCE_S: Final = 3.0
DISCARD: Final = 9
"""A port that nothing listens on: a host that is there refuses it at once."""
_LOCK: Final = re.compile(r"FLOCK .* (?P<pid>-?\d+) (?P<major>[0-9a-f]+):(?P<minor>[0-9a-f]+):(?P<inode>\d+) ")
_LOCKS: Final = Path("/proc/locks")
_BRIDGED: Final = (Platform.ARDUINO, Platform.STM32)
"""Platforms without a network of their own: their TCP port is a bridge's, which outlives its clients."""


@dataclass(frozen=True, slots=True)
class LinkCheck:
    """What was found of one car's link."""

    car: str
    link: str
    ok: bool
    words: str


def look(car: FleetCar, served: Mapping[str, tuple[str, str]]) -> LinkCheck:
    """Look at a car's link, for about `PATIENCE_S`. `served`: state and reason of the links of cars with a gateway."""
    if car.name in served:
        state, reason = served[car.name]
        ok = state in ("online", "quiet")
        words = f"its gateway runs, the link is {state}" + (f": {reason}" if reason and not ok else "")
        return LinkCheck(car.name, car.link, ok, words)
    ok, words = _look(parse_link(car.link), car.platform)
    return LinkCheck(car.name, car.link, ok, words)


def _look(link: LinkUrl, platform: str) -> tuple[bool, str]:
    match link.kind:
        case LinkKind.SIMULATED:
            return True, "`fleet up` simulates it"
        case LinkKind.DEVICE:
            return device(link.where)
        case LinkKind.USB:
            return _usb(link)
        case LinkKind.TCP:
            return _tcp(link, platform)
        case LinkKind.BLE:
            return _ble()


def device(path: str) -> tuple[bool, str]:
    """Whether a serial port is there, may be used and is free; nothing is opened."""
    if os.name != "posix":
        there = path.upper() in map(str.upper, _ports())
        return there, "the port is there; not opened" if there else "there is no such port: plug the car in"
    try:
        found = Path(path).stat()
    except OSError as error:
        if error.errno == errno.ENOENT:
            return False, "there is no such device: plug the car in, switch it on, or bind it again (fleet bind)"
        return False, f"cannot be looked at: {error.strerror}"
    if not stat.S_ISCHR(found.st_mode):
        return False, "is no serial port but a file or directory"
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(found.st_gid)
        return False, f"no permission: join the group {group} (sudo usermod -aG {group} $USER), then log in again"
    holder = _holder(found)
    if holder is not None:
        return False, f"in use by another program{holder}: end that first"
    free = "free" if _LOCKS.exists() else "whether it is free is not known here"
    return True, f"there, permitted, {free}; not opened, which can reset a car"


def _group(number: int) -> str:
    try:
        import grp
    except ImportError:  # not POSIX
        return str(number)
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _holder(found: os.stat_result) -> str | None:
    """Who has locked a device, as gateways do; None if nobody has, or the system does not tell (Linux does)."""
    try:
        locks = _LOCKS.read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    place = (os.major(found.st_dev), os.minor(found.st_dev), found.st_ino)
    for line in locks.splitlines():
        lock = _LOCK.search(line)
        if lock and (int(lock["major"], 16), int(lock["minor"], 16), int(lock["inode"])) == place:
            return f" (process {lock['pid']})" if int(lock["pid"]) > 0 else ""
    return None


def _ports() -> list[str]:
    from serial.tools import list_ports

    return [str(port.device) for port in list_ports.comports()]


def _usb(link: LinkUrl) -> tuple[bool, str]:
    from serial.tools import list_ports

    asked = dict(link.ids)
    fit = []
    for port in list_ports.comports():
        ids = {"serial": port.serial_number or ""}
        if port.vid is not None and port.pid is not None:
            ids |= {"vid": f"{port.vid:04x}", "pid": f"{port.pid:04x}"}
        if asked.items() <= ids.items():
            fit.append(str(port.device))
    if not fit:
        return False, "no such USB device is plugged in: plug the car in, or bind it again (fleet bind)"
    if len(fit) > 1:
        return False, f"{len(fit)} devices fit ({', '.join(sorted(fit))}): add a serial= that only one has"
    ok, words = device(fit[0])
    return ok, f"{fit[0]}: {words}"


def _tcp(link: LinkUrl, platform: str) -> tuple[bool, str]:
    bridge = platform.partition("+")[0] in _BRIDGED
    port = int(dict(link.ids)["port"])
    try:
        with socket.create_connection((link.where, port if bridge else DISCARD), timeout=PATIENCE_S):
            pass
    except ConnectionRefusedError:
        if bridge:
            return False, f"{link.where} is there, and nothing listens on port {port}: start the car's bridge"
    except TimeoutError:
        return False, f"no answer from {link.where} within {PATIENCE_S:g} s: switch the car on, join its network"
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that DNS cannot express
        words = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return False, f"{link.where}: {words}: switch the car on, join its network"
    if bridge:
        return True, "its bridge accepts connections"
    return True, f"{link.where} is there; not connected to port {port}, which would end the car's program"


def _ble() -> tuple[bool, str]:
    if find_spec("bleak") is None:
        return False, "needs Bluetooth, which is not installed: pip install 'zenoh-car-fleet[ble]'"
    return True, "Bluetooth is installed; whether the car is near, `gateway scan` shows"
