"""Lists the serial ports of this computer, each with the URL that stays the same after a replug. Opens nothing."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from gateway.link.usb import list_ports
from schemas.links import LinkUrl, SerialUrl, UsbUrl

if TYPE_CHECKING:
    from serial.tools.list_ports_common import ListPortInfo

BY_ID: Final = Path("/dev/serial/by-id")


class SerialPort(Struct, frozen=True):
    """A serial port of this computer. `url` is its most stable URL. vid and pid: four hexadecimal digits."""

    device: str
    url: str
    description: str = ""
    by_id: str | None = None
    vid: str | None = None
    pid: str | None = None
    serial_number: str | None = None


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this computer, sorted by name. Raises CannotOpen if the system does not list them."""
    return described(list_ports(), by_id(BY_ID))


def by_id(directory: Path) -> dict[str, str]:
    """Map each device to its name that stays the same after a replug (Linux)."""
    try:
        return {str(name.resolve()): str(name) for name in sorted(directory.iterdir())}
    except OSError:
        return {}


def described(found: "Iterable[ListPortInfo]", lasting: Mapping[str, str]) -> list[SerialPort]:
    """Return pyserial's ports, each with its most stable URL. `lasting` is the result of `by_id`."""
    ports = sorted(found)
    same = Counter((port.vid, port.serial_number) for port in ports)
    result = []
    for port in ports:
        url: LinkUrl = SerialUrl(lasting.get(port.device, port.device))
        # Some makers give the same serial number to all their devices, and some devices have several ports. So use the
        # number only if one port has it.
        if port.vid is not None and port.serial_number and same[port.vid, port.serial_number] == 1:
            url = UsbUrl(vid=port.vid, serial=port.serial_number)
        result.append(
            SerialPort(
                device=port.device,
                url=str(url),
                description="" if port.description in (None, "n/a", port.name) else port.description,
                by_id=lasting.get(port.device),
                vid=None if port.vid is None else f"{port.vid:04x}",
                pid=None if port.pid is None else f"{port.pid:04x}",
                serial_number=port.serial_number,
            )
        )
    return result
