"""The URLs that name a link."""

import re
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qs, urlsplit

from gateway.link.base import BadUrl

BAUD: Final = 9600  # protocol.md, framing: UART 9600 8N1
_BAUDS: Final = range(300, 4_000_001)
_ALLOWED: Final = (
    "serial:///dev/ttyUSB0 (?baud=9600), a bare device path such as /dev/ttyUSB0 or COM3, or tcp://host:8888"
)
_LATER: Final = frozenset({"ble"})
_WINDOWS_PORT: Final = re.compile(r"COM\d{1,3}", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class SerialUrl:
    """A serial port by its device path."""

    path: str
    baud: int = BAUD

    def __str__(self) -> str:
        return f"serial://{self.path}" + ("" if self.baud == BAUD else f"?baud={self.baud}")


@dataclass(frozen=True, slots=True)
class TcpUrl:
    """A car, or a bridge to one, that listens on TCP."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


LinkUrl = SerialUrl | TcpUrl


def parse_url(text: str) -> LinkUrl:
    """The link that a URL or a bare device path names; raises BadUrl, which says what is allowed."""
    if not text.isprintable():  # urlsplit would drop a line feed and say nothing
        raise _bad(text, "it has characters that cannot be printed")
    if text.startswith("/") or _WINDOWS_PORT.fullmatch(text):
        return SerialUrl(text)
    try:
        parts = urlsplit(text)
        port = parts.port if parts.scheme == "tcp" else None
    except ValueError as error:
        raise _bad(text, str(error)) from None
    if parts.scheme == "serial":
        if parts.fragment or not (parts.path.strip("/") or _WINDOWS_PORT.fullmatch(parts.netloc)):
            raise _bad(text, "it names no device")
        if parts.netloc and parts.path.strip("/"):
            raise _bad(text, "three slashes come before a device path")
        return SerialUrl(parts.path or parts.netloc, _baud(text, parts.query))
    if parts.scheme == "tcp":
        if not parts.hostname or not port:
            raise _bad(text, "a host and a port from 1 to 65535 are needed")
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            raise _bad(text, "nothing may follow the port")
        return TcpUrl(parts.hostname, port)
    if parts.scheme in _LATER:
        raise _bad(text, f"{parts.scheme}:// is not yet supported")
    raise _bad(
        text, f"{parts.scheme}:// is no kind of link" if parts.scheme else "it is neither a URL nor a device path"
    )


def _baud(text: str, query: str) -> int:
    fields = parse_qs(query, keep_blank_values=True)
    unknown = sorted(fields.keys() - {"baud"})
    if unknown:
        raise _bad(text, f"{', '.join(unknown)} is no option of a serial link")
    given = fields.get("baud", [str(BAUD)])[-1]
    if not (given.isascii() and given.isdecimal() and len(given) < 10) or int(given) not in _BAUDS:
        raise _bad(text, f"baud={given} is not from {_BAUDS.start} to {_BAUDS.stop - 1}")
    return int(given)


def _bad(text: str, why: str) -> BadUrl:
    return BadUrl(f"link {text!r} is not allowed, {why}: give {_ALLOWED}")
