"""Finds a USB adapter of a car that is plugged in and has no serial port (Linux). Opens nothing."""

from pathlib import Path
from typing import Final

from schemas.process.serial_port_users import is_running

CH340: Final = (0x1A86, 0x7523)
"""Ids of the CH340, the serial adapter of most cars. brltty mistakes it for a Braille display with the same ids."""
_CH340_TEXT: Final = f"{CH340[0]:04x}:{CH340[1]:04x}"
DEVICES: Final = Path("/sys/bus/usb/devices")
BRLTTY: Final = "brltty"


def explain_missing_port(devices: Path | None = None) -> str:
    """Return why a CH340 that is plugged in has no serial port, and what to type. Empty if each CH340 has its port."""
    # brltty detaches the driver of the adapter some seconds after it was plugged in, so the port appears and vanishes.
    if not any(map(_is_without_port, _adapters(DEVICES if devices is None else devices))):
        return ""
    plugged = f"A CH340 adapter ({_CH340_TEXT}) is plugged in and has no serial port"
    remove = "Type `sudo apt remove brltty`, then plug the car in again."
    if is_running(BRLTTY):
        return f"{plugged}: brltty, the program for Braille displays, has taken it. {remove}"
    missing = "Otherwise the driver is missing: `sudo modprobe ch341`."
    return f"{plugged}: brltty, a program for Braille displays, may have taken it. {remove} {missing}"


def _adapters(devices: Path) -> list[Path]:
    """Return the directories of the CH340 adapters."""
    try:
        found = list(devices.iterdir())
    except OSError:
        return []
    return [each for each in found if f"{_text(each / 'idVendor')}:{_text(each / 'idProduct')}" == _CH340_TEXT]


def _is_without_port(device: Path) -> bool:
    """Return True if none of the interfaces of a device has a serial port."""
    try:
        return not any(device.glob("*:*/tty*"))
    except OSError:  # just being unplugged
        return False


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
