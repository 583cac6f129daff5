"""Lists the Bluetooth LE devices that advertise, and which of them are likely a car's. Connects to nothing."""

import asyncio
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from bleak import BleakScanner
from bleak.args.bluez import BlueZScannerArgs
from bleak.backends.device import BLEDevice
from bleak.backends.scanner import AdvertisementData

from gateway.link import bluez
from gateway.link.base import Device
from gateway.link.link_exceptions import CannotList
from schemas.links import BleUrl
from schemas.process.stdio import printable

_SHORT: Final = re.compile(r"0000([0-9a-f]{4})-0000-1000-8000-00805f9b34fb")
BLE_START_TIMEOUT_S: Final = 5.0
"""Timeout for the start of a Bluetooth scan, on top of its duration."""


@dataclass(frozen=True, slots=True)
class BleDevice(Device):
    """An advertising Bluetooth LE device. `uart` is its service for serial bytes (UART), which modules of cars have."""

    address: str
    url: str
    name: str | None = None
    rssi: int | None = None
    services: tuple[str, ...] = ()
    uart: str | None = None

    def fields(self) -> dict[str, Any]:
        """Return the known facts."""
        return asdict(self)

    @property
    def heading(self) -> tuple[str, str]:
        """The address, and a text with the name and the signal strength."""
        return self.address, f"{printable(self.name) or 'no name'}, {self.rssi} dBm"

    @property
    def likely(self) -> str:
        """Why the device is probably a car's: its UART service. Empty if it has none."""
        return "" if self.uart is None else f"it has the Bluetooth service {self.uart}"


async def _discover(seconds: float) -> dict[str, tuple[BLEDevice, AdvertisementData]]:
    """Return the devices that advertise within this time to any adapter, by address. Raises whatever bleak raises."""
    # If there are several adapters, bleak would use any one of them, but a car may be in range of only one.
    options: list[BlueZScannerArgs] = [{"adapter": name} for name in await bluez.start_bleak()]
    scans = [BleakScanner.discover(timeout=seconds, return_adv=True, bluez=each) for each in options or [{}]]
    return {address: each for scan in await asyncio.gather(*scans) for address, each in scan.items()}


async def list_devices(seconds: float, uarts: Sequence[str]) -> list[BleDevice]:
    """Return the devices that advertise within this time, first those with a service in `uarts`. Raises CannotList."""
    try:
        async with asyncio.timeout(seconds + BLE_START_TIMEOUT_S):
            found = await _discover(seconds)
    except TimeoutError:
        raise CannotList("Bluetooth was not searched: its service does not answer. Is it running?") from None
    except Exception as error:  # noqa: BLE001 - whatever a system's Bluetooth stack raises, `scan` still lists the ports
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):  # D-Bus is missing
            raise CannotList("Bluetooth was not searched: no D-Bus or BlueZ is running here.") from None
        words = " ".join(str(error).split()) or type(error).__name__
        raise CannotList(f"Bluetooth was not searched: {words}. Is there an adapter, and is it on?") from None
    devices = [_device(address, device.name, advert, uarts) for address, (device, advert) in found.items()]
    return sorted(devices, key=lambda device: (device.uart is None, -(device.rssi or -999), device.address))


def _device(address: str, name: str | None, advert: AdvertisementData, uarts: Sequence[str]) -> BleDevice:
    services = tuple(service.lower() for service in advert.service_uuids)
    uart = next((service for service in services if service in uarts), None)
    if uart is not None and (short := _SHORT.fullmatch(uart)):
        uart = short[1].upper()
    url = str(BleUrl(address=address.upper()))
    return BleDevice(address, url, advert.local_name or name, advert.rssi, services, uart)
