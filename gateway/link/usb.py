"""Finds the serial port of a USB device. The port may change each time the device is plugged in. Opens nothing."""

import os
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from gateway.link.link_exceptions import CannotOpen
from schemas.links import SerialUrl, UsbUrl
from schemas.process.stdio import printable
from schemas.process.usb_bus import CH340, explain_missing_port

if TYPE_CHECKING:
    from serial.tools.list_ports_common import ListPortInfo

LIST_ATTEMPTS: Final = 3
LIST_RETRY_DELAY_S: Final = 0.05


class ListedPort(Struct, frozen=True):
    """A serial port of this computer. vid, pid and serial are set only for a USB device that reports them."""

    device: str
    vid: int | None = None
    pid: int | None = None
    serial: str | None = None

    @property
    def ids(self) -> tuple[int | None, int | None, str | None]:
        """The ids of the device, which stay the same wherever it is plugged in."""
        return self.vid, self.pid, self.serial

    def __str__(self) -> str:
        ids = "no USB device" if self.vid is None or self.pid is None else f"{self.vid:04x}:{self.pid:04x}"
        number = "" if self.serial is None else f" serial number {self.serial}"
        return f"{self.device} ({ids}{number})"


def list_serial_ports() -> list[ListedPort]:
    """Return the serial ports of this computer (slow on some systems). Raises CannotOpen if they cannot be listed."""
    return [ListedPort(port.device, port.vid, port.pid, port.serial_number) for port in list_ports()]


def list_ports() -> "list[ListPortInfo]":
    """Return the serial ports of this computer as pyserial describes them, or raise CannotOpen."""
    from serial.tools import list_ports as system

    failure: Exception | None = None
    for _ in range(LIST_ATTEMPTS):
        try:
            return list(system.comports())
        except (OSError, TypeError, ValueError) as error:
            # A device was unplugged while pyserial read its entry. A number in the entry is then missing.
            failure = error
            time.sleep(LIST_RETRY_DELAY_S)
    reason = " ".join(str(failure).split()) or type(failure).__name__
    raise CannotOpen(f"the serial ports cannot be listed ({reason}): is a device just being unplugged?")


def choose(url: UsbUrl, ports: Iterable[ListedPort]) -> ListedPort:
    """Return the only matching port. If there are none or several, CannotOpen says what was found instead."""
    available = sorted(ports, key=lambda port: port.device)
    fit = [port for port in available if url.fits(port.vid, port.pid, port.serial)]
    if len(fit) == 1:
        return fit[0]
    if fit:
        raise CannotOpen(
            f"{url}: {len(fit)} devices fit, {_named(fit)}: add the serial= of one of them, or give a device path"
        )
    if url.fits(*CH340, None) and (missing := explain_missing_port()):
        raise CannotOpen(f"{url}: no such serial port. {missing}")
    found = f"there are: {_named(available)}" if available else "no serial port is plugged in"
    raise CannotOpen(f"{url}: no such USB device is plugged in; {found}")


def port_at(path: str, ports: Iterable[ListedPort]) -> ListedPort | None:
    """Return the port at a device path or symlink. None if the system does not list it."""
    try:
        real = os.path.realpath(path)
    except ValueError:  # a path with a null byte
        return None
    return next((port for port in ports if os.path.realpath(port.device) == real), None)


def check_same_device(url: SerialUrl | UsbUrl, path: str, first: ListedPort | None, now: ListedPort | None) -> None:
    """Raise CannotOpen if the ids differ from those of the first device at this URL."""
    if first is None or first.vid is None or (now is not None and now.ids == first.ids):
        return
    if now is None and not os.path.exists(path):  # noqa: PTH110 - a device path, not a file to work with
        return  # the caller opens it next, which raises an error that says why
    found = f"{path}, which the system does not list, may be" if now is None else f"{_named([now])} is"
    raise CannotOpen(
        f"{url}: {found} another device than before, which was {_named([first])}. Plug the earlier device in again, or "
        "restart this program to use the other one"
    )


def _named(ports: list[ListedPort]) -> str:
    """Return the ports as one line. A device chooses its own serial number: replace what cannot be printed."""
    return printable(", ".join(map(str, ports)), "?")
