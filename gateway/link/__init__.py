"""Byte streams to a car: serial, TCP. Bytes only; what they mean is the protocol's."""

from gateway.link.base import BadUrl, Busy, CannotOpen, Link, LinkError, LinkLost
from gateway.link.url import LinkUrl, SerialUrl, TcpUrl, parse_url

__all__ = ["BadUrl", "Busy", "CannotOpen", "Link", "LinkError", "LinkLost", "LinkUrl", "open_link", "parse_url"]

OPEN_TIMEOUT_S = 5.0


async def open_link(url: LinkUrl, *, timeout_s: float = OPEN_TIMEOUT_S) -> Link:
    """Open the link; raises CannotOpen, whose text says what is wrong and what to do."""
    match url:
        case SerialUrl():
            from gateway.link.serial import open_serial

            return await open_serial(url, timeout_s)
        case TcpUrl():
            from gateway.link.tcp import open_tcp

            return await open_tcp(url, timeout_s)
