"""Which serial port a USB device has now: it may have another at each plugging in. Nothing is opened here."""

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from gateway.link.base import CannotOpen
from gateway.link.url import SerialUrl, UsbUrl

if TYPE_CHECKING:
    from serial.tools.list_ports_common import ListPortInfo

LISTINGS: Final = 3
LIST_AGAIN_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class UsbSerialPort:
    """A serial port that is there. vid, pid and serial only if it is a USB device that tells them."""

    device: str
    vid: int | None = None
    pid: int | None = None
    serial: str | None = None

    @property
    def ids(self) -> tuple[int | None, int | None, str | None]:
        """What the device says of itself, wherever it is plugged in."""
        return self.vid, self.pid, self.serial

    def __str__(self) -> str:
        ids = "no USB device" if self.vid is None or self.pid is None else f"{self.vid:04x}:{self.pid:04x}"
        number = "" if self.serial is None else f" serial number {self.serial}"
        return f"{self.device} ({ids}{number})"


def plugged() -> list[UsbSerialPort]:
    """The serial ports of this computer; raises CannotOpen. It reads the system's lists, which can take a while."""
    return [UsbSerialPort(port.device, port.vid, port.pid, port.serial_number) for port in listed()]


def listed() -> "list[ListPortInfo]":
    """The same in pyserial's words."""
    from serial.tools import list_ports

    failure: Exception | None = None
    for _ in range(LISTINGS):
        try:
            return list(list_ports.comports())
        except (OSError, TypeError, ValueError) as error:
            # A device that goes while it is looked at: pyserial takes the number of what it could not read.
            failure = error
            time.sleep(LIST_AGAIN_S)
    words = " ".join(str(failure).split()) or type(failure).__name__
    raise CannotOpen(f"the serial ports cannot be listed ({words}): is a device just being unplugged?")


def choose(url: UsbUrl, ports: Iterable[UsbSerialPort]) -> UsbSerialPort:
    """The one port that fits; raises CannotOpen, which says what was asked and what is there."""
    there = sorted(ports, key=lambda port: port.device)
    fit = [
        port
        for port in there
        if url.vid in (None, port.vid) and url.pid in (None, port.pid) and url.serial in (None, port.serial)
    ]
    if len(fit) == 1:
        return fit[0]
    if fit:
        raise CannotOpen(
            f"{url}: {len(fit)} devices fit, {_named(fit)}: add a serial= that only one has, or give its device path"
        )
    found = f"there are: {_named(there)}" if there else "no serial port is plugged in"
    raise CannotOpen(f"{url}: no such USB device is plugged in; {found}")


def at(path: str, ports: Iterable[UsbSerialPort]) -> UsbSerialPort | None:
    """The port that a device path, or a symlink, leads to; None if the system does not list it."""
    try:
        real = os.path.realpath(path)
    except ValueError:  # a path that the system cannot express
        return None
    return next((port for port in ports if os.path.realpath(port.device) == real), None)


def refuse_another(url: SerialUrl | UsbUrl, path: str, first: UsbSerialPort | None, now: UsbSerialPort | None) -> None:
    """Raise CannotOpen if there is another device than the first time, as far as they say which they are."""
    if first is None or first.vid is None or (now is not None and now.ids == first.ids):
        return
    if now is None and not os.path.exists(path):  # noqa: PTH110 - a device path, not a file to work with
        return  # opening it says so
    found = f"{path}, of which the system says nothing" if now is None else _named([now])
    raise CannotOpen(
        f"{url}: another device is there, {found}; it was {_named([first])}: plug that in again, or restart this "
        "program if it is the right one"
    )


def _named(ports: list[UsbSerialPort]) -> str:
    """For one line, without what a device has chosen to be called that cannot be printed."""
    return "".join(each if each.isprintable() else "?" for each in ", ".join(map(str, ports)))
