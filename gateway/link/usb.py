"""Which serial port a USB device has now: it may have another at each plugging in. Nothing is opened here."""

from collections.abc import Iterable
from dataclasses import dataclass

from gateway.link.base import CannotOpen
from gateway.link.url import UsbUrl


@dataclass(frozen=True, slots=True)
class Plugged:
    """A serial port that is there. vid, pid and serial only if it is a USB device that tells them."""

    device: str
    vid: int | None = None
    pid: int | None = None
    serial: str | None = None

    def __str__(self) -> str:
        ids = "no USB device" if self.vid is None or self.pid is None else f"{self.vid:04x}:{self.pid:04x}"
        number = "" if self.serial is None else f" serial number {self.serial}"
        return f"{self.device} ({ids}{number})"


def plugged() -> list[Plugged]:
    """The serial ports of this computer. It reads the system's lists of devices, which can take a while."""
    from serial.tools import list_ports

    return [Plugged(port.device, port.vid, port.pid, port.serial_number) for port in list_ports.comports()]


def choose(url: UsbUrl, ports: Iterable[Plugged]) -> str:
    """The device path of the one port that fits; raises CannotOpen, which says what was asked and what is there."""
    there = sorted(ports, key=lambda port: port.device)
    fit = [
        port
        for port in there
        if url.vid in (None, port.vid) and url.pid in (None, port.pid) and url.serial in (None, port.serial)
    ]
    if len(fit) == 1:
        return fit[0].device
    if fit:
        raise CannotOpen(
            f"{url}: {len(fit)} devices fit, {_listed(fit)}: add a serial= that only one has, or give its device path"
        )
    found = f"there are: {_listed(there)}" if there else "no serial port is plugged in"
    raise CannotOpen(f"{url}: no such USB device is plugged in; {found}")


def _listed(ports: list[Plugged]) -> str:
    """For one line, without what a device has chosen to be called that cannot be printed."""
    return "".join(each if each.isprintable() else "?" for each in ", ".join(map(str, ports)))
