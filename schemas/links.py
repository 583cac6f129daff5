"""Link URLs: each kind of link is a class, with its text, its port, its check and its help. Nothing is opened.

A kind of link is a class here and a row in `KINDS`. Its scheme is also the name of the module in `gateway.link`
that opens such links.
"""

import ipaddress
import os.path
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import combinations
from typing import ClassVar, Final, Protocol
from urllib.parse import SplitResult, parse_qs, quote, unquote, urlsplit

from schemas.suggestion import how_to_install, nearest

CAR_TCP_PORT: Final = 8888
"""The port on which the program of a Raspberry Pi car listens (docs/reference/protocol.md#platforms)."""
BAUD: Final = 9600  # docs/reference/protocol.md#framing: UART 9600 8N1
_BAUDS: Final = range(300, 4_000_001)
_WINDOWS_PORT: Final = re.compile(r"COM\d{1,3}", re.IGNORECASE)
_USB_ID: Final = re.compile(r"(?:0[xX])?([0-9a-fA-F]{4})")
_USB_FIELDS: Final = ("vid", "pid", "serial")
_BLE_ADDRESS: Final = re.compile(r"[0-9A-F]{2}(:[0-9A-F]{2}){5}|[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}")
_ADAPTER: Final = re.compile(r"auto|hci\d{1,3}")
AUTO_ADAPTER: Final = "auto"
"""In a Bluetooth link: any adapter with room."""
# Core Specification, vol. 3, part C, 3.2.2
_BLE_NAME_BYTES: Final = 248
"""Maximum length of the name of a Bluetooth device."""

PortKey = tuple[str, str, frozenset[tuple[str, str]]]
"""The kind of link, the device or host in one normal form, and the ids. Links with equal keys name the same port. But
one port may have several keys: a USB device has one for its path, and others for its ids."""


class BadLink(ValueError):
    """Text that is not a link. The message is the reason."""


class Look(Protocol):
    """Looks for the device or host of a link. Each method returns True if all is well, and a text."""

    def device(self, path: str) -> tuple[bool, str]:
        """Look at a serial port."""

    def usb(self, url: "UsbUrl") -> tuple[bool, str]:
        """Look for a USB device."""

    def host(self, host: str, port: int) -> tuple[bool, str]:
        """Look for a host. Connect to its port only where that cannot harm a car."""


# Plain classes: dataclasses, and what they import, took a fifth of the time until a gateway is on the bus.
class LinkUrl(ABC):
    """A link: how it is written, and what is known about it before it is opened. `str` returns its URL.

    Links with equal URLs are equal. A link never changes.
    """

    __slots__ = ()
    scheme: ClassVar[str]
    forms: ClassVar[tuple[str, ...]]
    """How a URL of this kind is written, for the help."""
    options: ClassVar[str] = ""
    """The options that may follow such a URL, for the help."""
    module: ClassVar[str] = ""
    """The Python module that this kind of link needs, but the basic installation lacks. Empty if there is none."""
    extra: ClassVar[str] = ""
    """The extra of our package that installs this module."""
    needs: ClassVar[str] = ""
    """The name of what the module brings, for people."""
    harm: ClassVar[str] = ""
    """The harm that opening and closing the link may do to a car, in words. Empty if none."""

    @classmethod
    @abstractmethod
    def parse(cls, text: str) -> "LinkUrl | None":
        """Return the link with this URL, or None if it is not a link after all. Raises BadLink if a part is wrong."""

    @classmethod
    def guess(cls, text: str) -> str:  # noqa: ARG003 - a kind may have no such texts
        """Return the URL that a text without a scheme probably means. Empty if none."""
        return ""

    @classmethod
    def missing(cls) -> str:
        """Say what must be installed for this kind of link. Empty if nothing."""
        if not cls.module or find_spec(cls.module) is not None:
            return ""
        return f"needs {cls.needs}, which is not installed: {how_to_install(cls.extra)}"

    @property
    @abstractmethod
    def port_key(self) -> PortKey:
        """The port that the link names. Symlinks are followed."""

    def possible_ports(self) -> Iterator[PortKey]:
        """Yield the key of this link, and those of vaguer links that may name its port (see `UsbUrl`)."""
        yield self.port_key

    def without_options(self) -> "LinkUrl":
        """Return the link without the options that say nothing about which car it is: baud rate and adapter."""
        return self

    def check(self, look: Look) -> tuple[bool, str]:  # noqa: ARG002 - Bluetooth cannot be looked at
        """Return True if a car may be there, and a text. Do not open what could move or reset a car."""
        if missing := self.missing():
            return False, missing
        return True, f"{self.needs} is installed; `fleet scan` shows whether the car is near"

    def doubt_baud(self) -> str:
        """Return a sentence that asks about the baud rate, for a link whose bytes contain no frame."""
        return f"Is the module at the baud rate of the car, {BAUD}?"

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and str(other) == str(self)

    def __hash__(self) -> int:
        return hash(str(self))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"


class _SerialLine(LinkUrl):
    """A serial port, named in one of two ways."""

    __slots__ = ("baud",)
    scheme = "serial"

    def __init__(self, baud: int) -> None:
        self.baud: Final = baud

    @abstractmethod
    def at_rate(self, baud: int) -> "LinkUrl":
        """Return the link with another baud rate."""

    def without_options(self) -> "LinkUrl":
        return self.at_rate(BAUD)

    @classmethod
    def parse(cls, text: str) -> "LinkUrl | None":
        parts = _split(text)
        if parts.fragment:
            raise BadLink("write # as %23, and only in a serial number")
        return _serial(parts.netloc, parts.path, parts.query)

    def doubt_baud(self) -> str:
        if self.baud != BAUD:
            return f"The port is at {self.baud} baud: cars use {BAUD}."
        return f"The port is at {self.baud} baud: does this car use another one (?baud=115200)?"


class SerialUrl(_SerialLine):
    """A serial port by its device path."""

    __slots__ = ("path",)
    forms = ("/dev/ttyUSB0",)

    def __init__(self, path: str, baud: int = BAUD) -> None:
        super().__init__(baud)
        self.path: Final = path

    def at_rate(self, baud: int) -> "SerialUrl":
        """Return the link with another baud rate."""
        return SerialUrl(self.path, baud)

    @classmethod
    def guess(cls, text: str) -> str:
        """Return the URL that a text without a scheme probably means. Empty if none."""
        return f"/dev/{text}" if re.fullmatch(r"(tty|cu\.|rfcomm)[\w.-]*", text) else ""

    @property
    def port_key(self) -> PortKey:
        """The port that the link names."""
        # Resolve symlinks such as those in /dev/serial/by-id. On Windows, COM3 and com3 are one port.
        device = self.path.upper() if _WINDOWS_PORT.fullmatch(self.path) else os.path.realpath(self.path)
        return ("device", device, frozenset())

    def check(self, look: Look) -> tuple[bool, str]:
        """Look for the port without opening the link."""
        return look.device(self.path)

    def __str__(self) -> str:
        return f"serial://{self.path}" + ("" if self.baud == BAUD else f"?baud={self.baud}")


class UsbUrl(_SerialLine):
    """A serial port by the ids of its USB device, wherever it is plugged in. At least one id is set.

    vid, pid: 0 to 0xFFFF. `serial` is the whole serial number of the device.
    """

    __slots__ = ("pid", "serial", "vid")
    forms = ("serial://?vid=1a86&serial=ABC",)

    def __init__(
        self, vid: int | None = None, pid: int | None = None, serial: str | None = None, baud: int = BAUD
    ) -> None:
        super().__init__(baud)
        self.vid: Final = vid
        self.pid: Final = pid
        self.serial: Final = serial

    def at_rate(self, baud: int) -> "UsbUrl":
        """Return the link with another baud rate."""
        return UsbUrl(self.vid, self.pid, self.serial, baud)

    def fits(self, vid: int | None, pid: int | None, serial: str | None) -> bool:
        """Return True if this link may mean a device with these ids."""
        return self.vid in (None, vid) and self.pid in (None, pid) and self.serial in (None, serial)

    @property
    def port_key(self) -> PortKey:
        """The port that the link names."""
        ids = (("vid", self.vid), ("pid", self.pid), ("serial", self.serial))
        return ("usb", "", frozenset((name, str(value)) for name, value in ids if value is not None))

    def possible_ports(self) -> Iterator[PortKey]:
        """Yield also the keys of links with fewer ids, because they may name this device too."""
        kind, where, ids = self.port_key
        for count in range(1, len(ids) + 1):
            for fewer in combinations(sorted(ids), count):
                yield (kind, where, frozenset(fewer))

    def check(self, look: Look) -> tuple[bool, str]:
        """Look for the device without opening the link."""
        return look.usb(self)

    def __str__(self) -> str:
        ids = [f"{name}={value:04x}" for name, value in (("vid", self.vid), ("pid", self.pid)) if value is not None]
        number = [] if self.serial is None else [f"serial={quote(self.serial, safe='')}"]
        baud = [] if self.baud == BAUD else [f"baud={self.baud}"]
        return "serial://?" + "&".join(ids + number + baud)


class TcpUrl(LinkUrl):
    """A car or a bridge that listens on TCP."""

    __slots__ = ("host", "port")
    scheme = "tcp"
    forms = ("tcp://host:8888",)
    harm = (
        "a Raspberry Pi car's program dies when a TCP client disconnects, also when this one does. Its motors "
        "then stay as they are."
    )

    def __init__(self, host: str, port: int) -> None:
        self.host: Final = host
        self.port: Final = port

    @classmethod
    def parse(cls, text: str) -> LinkUrl | None:
        """Return the link with this URL. Raises BadLink if a part is wrong."""
        parts = _split(text)
        try:
            port = parts.port
        except ValueError as error:
            raise BadLink(str(error)) from None
        if not parts.hostname or not port:
            if parts.hostname and not parts.netloc.rpartition("]")[2].count(":"):
                raise BadLink(f"the port is missing. Write {TcpUrl(parts.hostname, CAR_TCP_PORT)}")
            raise BadLink(f"it needs a host and a port from 1 to 65535. Write tcp://192.168.1.7:{CAR_TCP_PORT}")
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            raise BadLink("nothing may follow the port, and no user name may stand before the host")
        return TcpUrl(parts.hostname, port)

    @classmethod
    def guess(cls, text: str) -> str:
        """Return the URL that a text without a scheme probably means. Empty if none."""
        host = re.fullmatch(r"((?:\d{1,3}\.){3}\d{1,3}|\w[\w.-]*(?=:))(:\d{1,5})?", text)
        return f"tcp://{host[1]}{host[2] or f':{CAR_TCP_PORT}'}" if host else ""

    @property
    def port_key(self) -> PortKey:
        """The port that the link names."""
        return ("tcp", _host(self.host), frozenset({("port", str(self.port))}))

    def check(self, look: Look) -> tuple[bool, str]:
        """Look for the host without opening the link."""
        return look.host(self.host, self.port)

    def doubt_baud(self) -> str:
        """Return a sentence that asks about the baud rate."""
        return f"Is the bridge at the baud rate of the car, {BAUD}?"

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


class BleUrl(LinkUrl):
    """A car's Bluetooth LE module, by its address in capitals (on macOS: its UUID there) or by its name.

    `adapter` is the computer's adapter, such as hci1; `auto` for any with room; None for the first one.
    """

    __slots__ = ("adapter", "address", "name")
    scheme = "ble"
    forms = ("ble://ADDRESS or ble://name=BT04",)
    options = "?adapter=hci1 or auto"
    module, extra, needs = "bleak", "ble", "Bluetooth"

    def __init__(self, address: str | None = None, name: str | None = None, adapter: str | None = None) -> None:
        self.address: Final = address
        self.name: Final = name
        self.adapter: Final = adapter

    @classmethod
    def parse(cls, text: str) -> LinkUrl | None:
        """Return the link with this URL. Raises BadLink if a part is wrong."""
        # `urlsplit` would take the colons of an address for a port.
        return _ble(text[6:]) if text[3:6] == "://" else None

    @classmethod
    def guess(cls, text: str) -> str:
        """Return the URL that a text without a scheme probably means. Empty if none."""
        return f"ble://{text.upper()}" if _BLE_ADDRESS.fullmatch(text.upper()) else ""

    @property
    def port_key(self) -> PortKey:
        """The port that the link names."""
        return ("ble", self.address or "", frozenset() if self.name is None else frozenset({("name", self.name)}))

    def without_options(self) -> "BleUrl":
        """Return the link without its adapter."""
        return BleUrl(self.address, self.name)

    def __str__(self) -> str:
        adapter = "" if self.adapter is None else f"?adapter={self.adapter}"
        module = self.address if self.name is None else f"name={quote(self.name, safe='')}"
        return f"ble://{module}{adapter}"


KINDS: Final[tuple[type[LinkUrl], ...]] = (SerialUrl, UsbUrl, TcpUrl, BleUrl)
_BY_SCHEME: Final = {kind.scheme: kind for kind in KINDS}
LINK_HELP: Final = ", ".join(form for kind in KINDS for form in kind.forms)
"""How links are written, for the help of a command."""
LINK_HELP_OPTIONS: Final = "".join(f"; {kind.scheme}:// also with {kind.options}" for kind in KINDS if kind.options)
"""Options that some kinds of links have, for the help of a command."""


def car_link(url: LinkUrl) -> str:
    """Return the text of a link without the options that say nothing about which car it is: baud rate and adapter."""
    return str(url.without_options())


def parse_link(text: str) -> LinkUrl:
    """Return the link with this URL or bare device path. Raises BadLink if it is not a link."""
    if not text.isprintable():  # urlsplit drops a line feed without an error
        raise BadLink("it has characters that cannot be printed")
    if text.startswith("/") or _WINDOWS_PORT.fullmatch(text):
        return SerialUrl(text)
    scheme, colon, _ = text.lstrip().partition(":")
    kind = _BY_SCHEME.get(scheme.lower())
    if colon and kind is not None and (link := kind.parse(text)) is not None:
        return link
    _split(text)  # raises BadLink with the fault if this is no URL at all
    raise BadLink(f"this is not a link. {_likely_link(text)}`fleet scan` lists the links that are there.")


def _likely_link(text: str) -> str:
    """Return the link that a text without a scheme probably means, as a question, or an empty text if unknown."""
    scheme, colon, rest = text.partition("://")
    if colon and rest and (near := nearest(scheme, _BY_SCHEME)):
        return f"Did you mean {near}://{rest}? "
    likely = next((url for kind in KINDS if (url := kind.guess(text))), "")
    return f"Did you mean {likely}? " if likely else ""


def _split(text: str) -> SplitResult:
    try:
        return urlsplit(text)
    except ValueError as error:
        raise BadLink(str(error)) from None


def _host(host: str) -> str:
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower().rstrip(".")


def _serial(netloc: str, path: str, query: str) -> SerialUrl | UsbUrl:
    fields = parse_qs(query.replace("+", "%2B"), keep_blank_values=True)  # a + is a +, not a blank
    if unknown := sorted(fields.keys() - {"baud", *_USB_FIELDS}):
        raise BadLink(f"{', '.join(unknown)} is not an option of a serial link")
    if twice := sorted(name for name, values in fields.items() if len(values) > 1):
        raise BadLink(f"{', '.join(twice)} is given twice")
    options = {name: values[0] for name, values in fields.items()}
    baud = _baud(options.pop("baud", str(BAUD)))
    if path.strip("/") or netloc:
        if netloc and path.strip("/"):
            raise BadLink("write three slashes before a device path")
        if netloc and not _WINDOWS_PORT.fullmatch(netloc):
            raise BadLink(f"it names no device. Write the whole path, such as serial:///dev/{netloc}")
        if options:
            ids = ", ".join(name for name in _USB_FIELDS if name in options)
            raise BadLink(f"it names both a device path and {ids}: write only one of the two")
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
        raise BadLink(f"adapter={adapter[:20]} is not an adapter. Write adapter=hci1, or adapter=auto")
    chosen = adapter if option else None
    if rest.startswith("name="):
        name = unquote(rest[5:])
        if not name or not name.isprintable() or len(name.encode()) > _BLE_NAME_BYTES:
            raise BadLink(f"a name must have 1 to {_BLE_NAME_BYTES} bytes, all printable")
        return BleUrl(name=name, adapter=chosen)
    if _BLE_ADDRESS.fullmatch(rest.upper()) is None:
        raise BadLink("it has neither a Bluetooth address nor a name=")
    return BleUrl(address=rest.upper(), adapter=chosen)


def _split_adapter(rest: str) -> tuple[str, str, str]:
    """Return the module, the option if there is one, and the adapter. A name may have a ? of its own."""
    module, option, adapter = rest.rpartition("?adapter=")
    return (module, option, adapter) if option else (rest, "", "")
