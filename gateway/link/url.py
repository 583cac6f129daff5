"""The URLs that name a link."""

import re
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qs, quote, unquote, urlsplit

from gateway.link.base import BadUrl

BAUD: Final = 9600  # docs/reference/protocol.md#framing: UART 9600 8N1
_BAUDS: Final = range(300, 4_000_001)
_ALLOWED: Final = (
    "serial:///dev/ttyUSB0 (?baud=9600), a bare device path such as /dev/ttyUSB0 or COM3, "
    "serial://?vid=1a86&pid=7523&serial=ABC (one of the three is enough), tcp://host:8888, "
    "ble://AA:BB:CC:DD:EE:FF (on macOS the UUID that `gateway scan` shows), or ble://name=BT04"
)
_WINDOWS_PORT: Final = re.compile(r"COM\d{1,3}", re.IGNORECASE)
_USB_ID: Final = re.compile(r"(?:0[xX])?([0-9a-fA-F]{4})")
_USB_FIELDS: Final = ("vid", "pid", "serial")
_BLE_ADDRESS: Final = re.compile(r"[0-9A-F]{2}(:[0-9A-F]{2}){5}|[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}")
_BLE_NAME_BYTES: Final = 248
"""The longest name that a Bluetooth device can have (Core Specification, vol. 3, part C, 3.2.2)."""


@dataclass(frozen=True, slots=True)
class SerialUrl:
    """A serial port by its device path."""

    path: str
    baud: int = BAUD

    def __str__(self) -> str:
        return f"serial://{self.path}" + ("" if self.baud == BAUD else f"?baud={self.baud}")


@dataclass(frozen=True, slots=True)
class UsbUrl:
    """A serial port by what its USB device says of itself, wherever it is plugged in. At least one is given.

    vid, pid: 0 to 0xFFFF. serial: the whole serial number, as the device tells it.
    """

    vid: int | None = None
    pid: int | None = None
    serial: str | None = None
    baud: int = BAUD

    def __str__(self) -> str:
        ids = [f"{name}={value:04x}" for name, value in (("vid", self.vid), ("pid", self.pid)) if value is not None]
        number = [] if self.serial is None else [f"serial={quote(self.serial, safe='')}"]
        baud = [] if self.baud == BAUD else [f"baud={self.baud}"]
        return "serial://?" + "&".join(ids + number + baud)


@dataclass(frozen=True, slots=True)
class TcpUrl:
    """A car, or a bridge to one, that listens on TCP."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class BleUrl:
    """A car's Bluetooth LE module, by its address in capitals (on macOS: the UUID it has there), or by its name."""

    address: str | None = None
    name: str | None = None

    def __str__(self) -> str:
        return f"ble://{self.address}" if self.name is None else f"ble://name={quote(self.name, safe='')}"


LinkUrl = SerialUrl | UsbUrl | TcpUrl | BleUrl


def parse_url(text: str) -> LinkUrl:
    """The link that a URL or a bare device path names; raises BadUrl, which says what is allowed.

    A ble:// URL is refused where bleak is not installed, so that nothing is started that can never be opened.
    """
    if not text.isprintable():  # urlsplit would drop a line feed and say nothing
        raise _bad(text, "it has characters that cannot be printed")
    if text.startswith("/") or _WINDOWS_PORT.fullmatch(text):
        return SerialUrl(text)
    if text[:6].lower() == "ble://":  # not urlsplit's: the colons of an address are no port
        return _ble(text, text[6:])
    try:
        parts = urlsplit(text)
        port = parts.port if parts.scheme == "tcp" else None
    except ValueError as error:
        raise _bad(text, str(error)) from None
    if parts.scheme == "serial":
        if parts.fragment:
            raise _bad(text, "a # is written %23, and that only in a serial number")
        return _serial(text, parts.netloc, parts.path, parts.query)
    if parts.scheme == "tcp":
        if not parts.hostname or not port:
            raise _bad(text, "a host and a port from 1 to 65535 are needed")
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            raise _bad(text, "nothing may follow the port")
        return TcpUrl(parts.hostname, port)
    raise _bad(
        text, f"{parts.scheme}:// is no kind of link" if parts.scheme else "it is neither a URL nor a device path"
    )


def _serial(text: str, netloc: str, path: str, query: str) -> SerialUrl | UsbUrl:
    fields = parse_qs(query.replace("+", "%2B"), keep_blank_values=True)  # a + is a +, not a blank
    if unknown := sorted(fields.keys() - {"baud", *_USB_FIELDS}):
        raise _bad(text, f"{', '.join(unknown)} is no option of a serial link")
    if twice := sorted(name for name, values in fields.items() if len(values) > 1):
        raise _bad(text, f"{', '.join(twice)} is given twice")
    given = {name: values[0] for name, values in fields.items()}
    baud = _baud(text, given.get("baud", str(BAUD)))
    named = [name for name in _USB_FIELDS if name in given]
    if path.strip("/") or netloc:
        if netloc and path.strip("/"):
            raise _bad(text, "three slashes come before a device path")
        if netloc and not _WINDOWS_PORT.fullmatch(netloc):
            raise _bad(text, "it names no device")
        if named:
            raise _bad(text, f"it names a device path, and {', '.join(named)} too: one of the two")
        return SerialUrl(path or netloc, baud)
    if not named:
        raise _bad(text, "it names no device")
    if given.get("serial") == "":
        raise _bad(text, "serial= is empty")
    return UsbUrl(_usb_id(text, "vid", given), _usb_id(text, "pid", given), given.get("serial"), baud)


def _baud(text: str, given: str) -> int:
    if not (given.isascii() and given.isdecimal() and len(given) < 10) or int(given) not in _BAUDS:
        raise _bad(text, f"baud={given} is not from {_BAUDS.start} to {_BAUDS.stop - 1}")
    return int(given)


def _usb_id(text: str, name: str, given: dict[str, str]) -> int | None:
    """Four hexadecimal digits, with or without 0x: as lsusb and every list of devices writes them.

    Not decimal: 2341 is the vendor of an Arduino, in hexadecimal, and could not be told from it.
    """
    if name not in given:
        return None
    found = _USB_ID.fullmatch(given[name])
    if found is None:
        raise _bad(text, f"{name}={given[name]} is not four hexadecimal digits")
    return int(found[1], 16)


def _ble(text: str, rest: str) -> BleUrl:
    if rest.startswith("name="):
        url = BleUrl(name=unquote(rest[5:]))
        if not url.name or not url.name.isprintable() or len(url.name.encode()) > _BLE_NAME_BYTES:
            raise _bad(text, f"a name has 1 to {_BLE_NAME_BYTES} bytes, and can be printed")
    else:
        url = BleUrl(address=rest.upper())
        if _BLE_ADDRESS.fullmatch(rest.upper()) is None:
            raise _bad(text, "it names no Bluetooth address, and no name=")
    from importlib.util import find_spec

    if find_spec("bleak") is None:
        raise BadUrl(f"link {text!r} needs Bluetooth, which is not installed: pip install 'zenoh-car-fleet[ble]'")
    return url


def _bad(text: str, why: str) -> BadUrl:
    return BadUrl(f"link {text!r} is not allowed, {why}: give {_ALLOWED}")
