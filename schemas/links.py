"""Link URLs: the kinds of links and the only parser of their text. Pure; nothing is opened."""

import re
from dataclasses import dataclass, replace
from typing import Final
from urllib.parse import parse_qs, quote, unquote, urlsplit

from schemas.suggestion import nearest

CAR_TCP_PORT: Final = 8888
"""The port on which the program of a Raspberry Pi car listens (docs/reference/protocol.md#platforms)."""
BAUD: Final = 9600  # docs/reference/protocol.md#framing: UART 9600 8N1
_BAUDS: Final = range(300, 4_000_001)
_SCHEMES: Final = ("ble", "serial", "tcp")
WINDOWS_PORT: Final = re.compile(r"COM\d{1,3}", re.IGNORECASE)
_USB_ID: Final = re.compile(r"(?:0[xX])?([0-9a-fA-F]{4})")
_USB_FIELDS: Final = ("vid", "pid", "serial")
_BLE_ADDRESS: Final = re.compile(r"[0-9A-F]{2}(:[0-9A-F]{2}){5}|[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}")
_ADAPTER: Final = re.compile(r"auto|hci\d{1,3}")
AUTO_ADAPTER: Final = "auto"
"""The adapter of a Bluetooth link that takes any adapter with room."""
# Core Specification, vol. 3, part C, 3.2.2
_BLE_NAME_BYTES: Final = 248
"""Maximum length of the name of a Bluetooth device."""


class BadLink(ValueError):
    """Text that is no link. The message is the reason."""


@dataclass(frozen=True, slots=True)
class SerialUrl:
    """A serial port by its device path."""

    path: str
    baud: int = BAUD

    def __str__(self) -> str:
        return f"serial://{self.path}" + ("" if self.baud == BAUD else f"?baud={self.baud}")


@dataclass(frozen=True, slots=True)
class UsbUrl:
    """A serial port by the ids of its USB device, wherever it is plugged in. At least one id is set.

    vid, pid: 0 to 0xFFFF. serial: the whole serial number of the device.
    """

    vid: int | None = None
    pid: int | None = None
    serial: str | None = None
    baud: int = BAUD

    def fits(self, vid: int | None, pid: int | None, serial: str | None) -> bool:
        """Return True if a device with these ids may be the one."""
        return self.vid in (None, vid) and self.pid in (None, pid) and self.serial in (None, serial)

    def __str__(self) -> str:
        ids = [f"{name}={value:04x}" for name, value in (("vid", self.vid), ("pid", self.pid)) if value is not None]
        number = [] if self.serial is None else [f"serial={quote(self.serial, safe='')}"]
        baud = [] if self.baud == BAUD else [f"baud={self.baud}"]
        return "serial://?" + "&".join(ids + number + baud)


@dataclass(frozen=True, slots=True)
class TcpUrl:
    """A car or a bridge that listens on TCP."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class BleUrl:
    """A car's Bluetooth LE module, by its address in capitals (on macOS: its UUID there) or by its name.

    adapter: the computer's adapter, such as hci1; `auto` for any with room; None for the first one.
    """

    address: str | None = None
    name: str | None = None
    adapter: str | None = None

    def __str__(self) -> str:
        adapter = "" if self.adapter is None else f"?adapter={self.adapter}"
        module = self.address if self.name is None else f"name={quote(self.name, safe='')}"
        return f"ble://{module}{adapter}"


LinkUrl = SerialUrl | UsbUrl | TcpUrl | BleUrl


def car_link(url: LinkUrl) -> str:
    """Return the text of a link without the options that do not tell cars apart: baud rate and adapter."""
    match url:
        case SerialUrl() | UsbUrl():
            return str(replace(url, baud=BAUD))
        case BleUrl():
            return str(replace(url, adapter=None))
        case TcpUrl():
            return str(url)


def parse_link(text: str) -> LinkUrl:
    """Return the link with this URL or bare device path; raise BadLink."""
    if not text.isprintable():  # urlsplit drops a line feed without an error
        raise BadLink("it has characters that cannot be printed")
    if text.startswith("/") or WINDOWS_PORT.fullmatch(text):
        return SerialUrl(text)
    if text[:6].lower() == "ble://":  # urlsplit would take the colons of an address for a port
        return _ble(text[6:])
    try:
        parts = urlsplit(text)
        port = parts.port if parts.scheme == "tcp" else None
    except ValueError as error:
        raise BadLink(str(error)) from None
    if parts.scheme == "serial":
        if parts.fragment:
            raise BadLink("a # is written %23, and that only in a serial number")
        return _serial(parts.netloc, parts.path, parts.query)
    if parts.scheme == "tcp":
        if not parts.hostname or not port:
            if parts.hostname and not parts.netloc.rpartition("]")[2].count(":"):
                raise BadLink(f"the port is missing. Write tcp://{parts.hostname}:{CAR_TCP_PORT}")
            raise BadLink(f"it needs a host and a port from 1 to 65535. Write tcp://192.168.1.7:{CAR_TCP_PORT}")
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            raise BadLink("nothing may follow the port")
        return TcpUrl(parts.hostname, port)
    raise BadLink(f"this is not a link. {_likely_link(text)}`fleet scan` lists the links that are there.")


def _likely_link(text: str) -> str:
    """Return the link that a text without a scheme probably means, as a question; empty if unknown."""
    scheme, colon, rest = text.partition("://")
    if colon and rest and (near := nearest(scheme, _SCHEMES)):
        return f"Did you mean {near}://{rest}? "
    if re.fullmatch(r"(tty|cu\.|rfcomm)[\w.-]*", text):
        return f"Did you mean /dev/{text}? "
    if _BLE_ADDRESS.fullmatch(text.upper()):
        return f"Did you mean ble://{text.upper()}? "
    if host := re.fullmatch(r"((?:\d{1,3}\.){3}\d{1,3}|\w[\w.-]*(?=:))(:\d{1,5})?", text):
        return f"Did you mean tcp://{host[1]}{host[2] or f':{CAR_TCP_PORT}'}? "
    return ""


def _serial(netloc: str, path: str, query: str) -> SerialUrl | UsbUrl:
    fields = parse_qs(query.replace("+", "%2B"), keep_blank_values=True)  # a + is a +, not a blank
    if unknown := sorted(fields.keys() - {"baud", *_USB_FIELDS}):
        raise BadLink(f"{', '.join(unknown)} is no option of a serial link")
    if twice := sorted(name for name, values in fields.items() if len(values) > 1):
        raise BadLink(f"{', '.join(twice)} is given twice")
    options = {name: values[0] for name, values in fields.items()}
    baud = _baud(options.pop("baud", str(BAUD)))
    if path.strip("/") or netloc:
        if netloc and path.strip("/"):
            raise BadLink("three slashes come before a device path")
        if netloc and not WINDOWS_PORT.fullmatch(netloc):
            raise BadLink("it names no device")
        if options:
            ids = ", ".join(name for name in _USB_FIELDS if name in options)
            raise BadLink(f"it names a device path, and {ids} too: one of the two")
        return SerialUrl(path or netloc, baud)
    if not options:
        raise BadLink("it names no device")
    if options.get("serial") == "":
        raise BadLink("serial= is empty")
    return UsbUrl(_usb_id("vid", options), _usb_id("pid", options), options.get("serial"), baud)


def _baud(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 10) or int(text) not in _BAUDS:
        raise BadLink(f"baud={text[:20]} is not from {_BAUDS.start} to {_BAUDS.stop - 1}")
    return int(text)


# Four hexadecimal digits, with or without 0x, as lsusb and every list of devices writes them. Decimal is not accepted:
# 2341 is the vendor of an Arduino in hexadecimal, and looks like a decimal number.
def _usb_id(name: str, options: dict[str, str]) -> int | None:
    if name not in options:
        return None
    found = _USB_ID.fullmatch(options[name])
    if found is None:
        raise BadLink(f"{name}={options[name]} is not four hexadecimal digits")
    return int(found[1], 16)


def _ble(rest: str) -> BleUrl:
    rest, option, adapter = _split_adapter(rest)
    if option and _ADAPTER.fullmatch(adapter) is None:
        raise BadLink(f"adapter={adapter[:20]} is no adapter. Write adapter=hci1, or adapter=auto")
    chosen = adapter if option else None
    if rest.startswith("name="):
        name = unquote(rest[5:])
        if not name or not name.isprintable() or len(name.encode()) > _BLE_NAME_BYTES:
            raise BadLink(f"a name has 1 to {_BLE_NAME_BYTES} bytes, and can be printed")
        return BleUrl(name=name, adapter=chosen)
    if _BLE_ADDRESS.fullmatch(rest.upper()) is None:
        raise BadLink("it names no Bluetooth address, and no name=")
    return BleUrl(address=rest.upper(), adapter=chosen)


def _split_adapter(rest: str) -> tuple[str, str, str]:
    """Return the module, the option if there is one, and the adapter. A name may have a ? of its own."""
    module, option, adapter = rest.rpartition("?adapter=")
    return (module, option, adapter) if option else (rest, "", "")
