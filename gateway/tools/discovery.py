"""Lists serial ports and Bluetooth LE devices that could be cars. Opens and connects nothing."""

import asyncio
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gateway.link.usb import list_ports
from schemas.links import BleUrl, LinkUrl, SerialUrl, UsbUrl
from schemas.suggestion import how_to_install

if TYPE_CHECKING:
    from bleak.backends.scanner import AdvertisementData
    from serial.tools.list_ports_common import ListPortInfo

_SHORT: Final = re.compile(r"0000([0-9a-f]{4})-0000-1000-8000-00805f9b34fb")
BY_ID: Final = Path("/dev/serial/by-id")
BLE_START_TIMEOUT_S: Final = 5.0
"""Timeout for the start of a Bluetooth scan, on top of its duration."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this computer. `url`: its most stable URL. vid and pid: four hexadecimal digits."""

    device: str
    url: str
    description: str = ""
    by_id: str | None = None
    vid: str | None = None
    pid: str | None = None
    serial_number: str | None = None


@dataclass(frozen=True, slots=True)
class BleDevice:
    """An advertising Bluetooth LE device. `uart`: its UART service, which cars' modules have."""

    address: str
    url: str
    name: str | None = None
    rssi: int | None = None
    services: tuple[str, ...] = ()
    uart: str | None = None


class NoBluetooth(Exception):
    """Bluetooth cannot be scanned. The message is one line: why, what to do."""


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this computer by name; raise CannotOpen if the system does not list them."""
    return described(list_ports(), by_id(BY_ID))


def by_id(directory: Path) -> dict[str, str]:
    """Return by device the name that stays the same after a replug (Linux)."""
    try:
        return {str(name.resolve()): str(name) for name in sorted(directory.iterdir())}
    except OSError:
        return {}


def described(found: "Iterable[ListPortInfo]", lasting: Mapping[str, str]) -> list[SerialPort]:
    """Return pyserial's ports, each with its most stable URL. `lasting`: the result of `by_id`."""
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
    """Return the devices that advertise within this time, likely cars first; raise NoBluetooth."""
    try:
        from gateway.link.ble import UART_SERVICES, discover
    except ImportError:
        raise NoBluetooth(f"Bluetooth was not searched. Type: {how_to_install('ble')}") from None
    try:
        async with asyncio.timeout(seconds + BLE_START_TIMEOUT_S):
            found = await discover(seconds)
    except TimeoutError:
        raise NoBluetooth("Bluetooth was not searched: its service does not answer. Is it running?") from None
    except Exception as error:  # noqa: BLE001 - whatever a system's Bluetooth stack raises, `scan` still lists the ports
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):  # the socket of D-Bus
            raise NoBluetooth("Bluetooth was not searched: no D-Bus or BlueZ is running here.") from None
        words = " ".join(str(error).split()) or type(error).__name__
        raise NoBluetooth(f"Bluetooth was not searched: {words}. Is there an adapter, and is it on?") from None
    devices = [_device(address, device.name, advert, UART_SERVICES) for address, (device, advert) in found.items()]
    return sorted(devices, key=lambda device: (device.uart is None, -(device.rssi or -999), device.address))


def _device(address: str, name: str | None, advert: "AdvertisementData", uarts: Sequence[str]) -> BleDevice:
    services = tuple(service.lower() for service in advert.service_uuids)
    uart = next((service for service in services if service in uarts), None)
    if uart is not None and (short := _SHORT.fullmatch(uart)):
        uart = short[1].upper()
    url = str(BleUrl(address=address.upper()))
    return BleDevice(address, url, advert.local_name or name, advert.rssi, services, uart)
