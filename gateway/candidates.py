"""What there is that could be a car: serial ports and Bluetooth LE devices. Nothing is opened or connected to here."""

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from gateway.link import BadUrl, parse_url

BY_ID: Final = Path("/dev/serial/by-id")
_UART_SERVICES: Final = {
    "0000ffe0-0000-1000-8000-00805f9b34fb": "FFE0",
    "6e400001-b5a3-f393-e0a9-e50e24dcca9e": "Nordic UART",
}
"""protocol.md, framing: the services of the usual UART-over-BLE modules."""
_START_S: Final = 5.0
"""A Bluetooth stack that has not begun to scan by then never will."""


@dataclass(frozen=True, slots=True)
class Port:
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
    """A Bluetooth LE device that advertises. `uart`: the UART service that it names, as cars' modules do."""

    address: str
    url: str
    name: str | None = None
    rssi: int | None = None
    services: tuple[str, ...] = ()
    uart: str | None = None


class NoBluetooth(Exception):
    """Bluetooth cannot be looked at; the text is one line: why, what to do."""


def serial_ports() -> list[Port]:
    """The serial ports of this computer, by name."""
    from serial.tools import list_ports

    lasting = by_id(BY_ID)
    return [_port(found, lasting.get(found.device)) for found in sorted(list_ports.comports())]


def by_id(directory: Path) -> dict[str, str]:
    """Device: the name that stays the same when it is plugged in again (Linux)."""
    try:
        return {str(name.resolve()): str(name) for name in sorted(directory.iterdir())}
    except OSError:
        return {}


def _port(found: Any, lasting: str | None) -> Port:
    vid = None if found.vid is None else f"{found.vid:04x}"
    urls = [f"serial://?vid={vid}&serial={quote(found.serial_number, safe='')}"] if vid and found.serial_number else []
    urls += [path for path in (lasting, found.device) if path]
    return Port(
        device=found.device,
        url=_first_allowed(urls),
        description="" if found.description in (None, "n/a", found.name) else found.description,
        by_id=lasting,
        vid=vid,
        pid=None if found.pid is None else f"{found.pid:04x}",
        serial_number=found.serial_number,
    )


def _first_allowed(urls: Iterable[str]) -> str:
    """The first that `--link` takes."""
    for text in urls:
        try:
            return str(parse_url(text))
        except BadUrl:
            continue
    raise AssertionError("a device path is a URL")


async def ble_devices(seconds: float) -> list[BleDevice]:
    """The devices that advertise within this time, likely cars first; raises NoBluetooth."""
    try:
        from bleak import BleakScanner
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
    devices = [_device(address, device.name, heard) for address, (device, heard) in found.items()]
    return sorted(devices, key=lambda device: (device.uart is None, -(device.rssi or -999), device.address))


def _device(address: str, name: str | None, heard: Any) -> BleDevice:
    services = tuple(service.lower() for service in heard.service_uuids)
    uart = next((_UART_SERVICES[service] for service in services if service in _UART_SERVICES), None)
    return BleDevice(address, f"ble://{address}", heard.local_name or name, heard.rssi, services, uart)
