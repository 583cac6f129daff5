"""What there is that could be a car: serial ports and Bluetooth LE devices. Nothing is opened or connected to here."""

import asyncio
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gateway.link.url import BleUrl, LinkUrl, SerialUrl, UsbUrl
from gateway.link.usb import listed

if TYPE_CHECKING:
    from bleak.backends.scanner import AdvertisementData
    from serial.tools.list_ports_common import ListPortInfo

_SHORT: Final = re.compile(r"0000([0-9a-f]{4})-0000-1000-8000-00805f9b34fb")
BY_ID: Final = Path("/dev/serial/by-id")
_START_S: Final = 5.0
"""A Bluetooth stack that has not begun to scan by then never will."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port, as the system knows it. `url`: the most lasting that names it; vid and pid: four hex digits."""

    device: str
    url: str
    description: str = ""
    by_id: str | None = None
    vid: str | None = None
    pid: str | None = None
    serial_number: str | None = None


@dataclass(frozen=True, slots=True)
class BleDevice:
    """A Bluetooth LE device that advertises. `uart`: the UART service among its own, as cars' modules have."""

    address: str
    url: str
    name: str | None = None
    rssi: int | None = None
    services: tuple[str, ...] = ()
    uart: str | None = None


class NoBluetooth(Exception):
    """Bluetooth cannot be looked at; the text is one line: why, what to do."""


def serial_ports() -> list[SerialPort]:
    """The serial ports of this computer, by name; raises CannotOpen if the system does not list them."""
    return described(listed(), by_id(BY_ID))


def by_id(directory: Path) -> dict[str, str]:
    """Device: the name that stays the same when it is plugged in again (Linux)."""
    try:
        return {str(name.resolve()): str(name) for name in sorted(directory.iterdir())}
    except OSError:
        return {}


def described(found: "Iterable[ListPortInfo]", lasting: Mapping[str, str]) -> list[SerialPort]:
    """The ports that pyserial found, each with the URL that names it best; `lasting` as `by_id` gives it."""
    ports = sorted(found)
    same = Counter((port.vid, port.serial_number) for port in ports)
    result = []
    for port in ports:
        url: LinkUrl = SerialUrl(lasting.get(port.device, port.device))
        # Some makers give every device one serial number, and some devices are several ports.
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


async def ble_devices(seconds: float) -> list[BleDevice]:
    """The devices that advertise within this time, likely cars first; raises NoBluetooth."""
    try:
        from bleak import BleakScanner

        from gateway.link.ble import UART_SERVICES
    except ImportError:
        raise NoBluetooth(
            "Bluetooth was not looked at: pip install 'zenoh-car-fleet[ble]' adds what that takes"
        ) from None
    try:
        async with asyncio.timeout(seconds + _START_S):
            found = await BleakScanner.discover(timeout=seconds, return_adv=True)
    except TimeoutError:
        raise NoBluetooth("Bluetooth was not looked at: it does not answer: is its service running?") from None
    except Exception as error:  # noqa: BLE001 - whatever a system's Bluetooth stack raises, the ports are still shown
        words = " ".join(str(error).split()) or type(error).__name__
        raise NoBluetooth(f"Bluetooth was not looked at: {words}: is there an adapter, and is it on?") from None
    devices = [_device(address, device.name, heard, UART_SERVICES) for address, (device, heard) in found.items()]
    return sorted(devices, key=lambda device: (device.uart is None, -(device.rssi or -999), device.address))


def _device(address: str, name: str | None, heard: "AdvertisementData", uarts: Sequence[str]) -> BleDevice:
    services = tuple(service.lower() for service in heard.service_uuids)
    uart = next((service for service in services if service in uarts), None)
    if uart is not None and (short := _SHORT.fullmatch(uart)):
        uart = short[1].upper()
    url = str(BleUrl(address=address.upper()))
    return BleDevice(address, url, heard.local_name or name, heard.rssi, services, uart)
