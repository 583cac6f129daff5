"""A device on the console's network side: raw HTTPS requests and a WebSocket, with a cookie or without."""

import contextlib
import http.client
import json
import re
import select
import ssl
import threading
from typing import Any, Self

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tests.support.console import ConsoleProcess
from tests.support.processes import wait_for


class _OneThreadAtATime(ssl.SSLSocket):
    """A TLS socket that a thread may read while another writes.

    OpenSSL forbids a read during a write, and Python 3.11 does not prevent one. `websockets.sync` reads in a thread of
    its own. Of 1,000 connections without this class, two failed with "internal error" or an end of the stream.
    """

    _used: threading.Lock

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        made = super().__new__(cls, *arguments, **options)
        made._used = threading.Lock()
        return made

    def recv(self, buflen: int = 1024, flags: int = 0) -> bytes:
        while True:
            with self._used:  # hold no lock while waiting: the received bytes may belong to TLS only
                self.setblocking(False)
                try:
                    return super().recv(buflen, flags)
                except ssl.SSLWantReadError:
                    pass
                finally:
                    self.setblocking(True)
            select.select([self], [], [])

    def send(self, data: Any, flags: int = 0) -> int:
        with self._used:
            return super().send(data, flags)


def untrusting() -> ssl.SSLContext:
    """Return a TLS context that accepts any certificate, such as the console's own."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.sslsocket_class = _OneThreadAtATime
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


class NetworkDevice:
    """A client of the console's network port, as a phone is. That port treats `127.0.0.1` as any other address."""

    def __init__(self, port: int, host: str = "127.0.0.1", source: str | None = None) -> None:
        self.host, self.port = host, port
        self.source = None if source is None else (source, 0)
        self.origin = f"https://{host}:{port}"
        self.cookie = ""

    def connection(self) -> http.client.HTTPSConnection:
        """Return a connection for several requests."""
        return http.client.HTTPSConnection(
            self.host, self.port, timeout=30, context=untrusting(), source_address=self.source
        )

    def ask(self, verb: str, path: str, body: str | None = None, **headers: str) -> tuple[int, bytes]:
        """Send a request, and return status and text. Store a new cookie. Leave out a header without value."""
        connection = self.connection()
        sent = {"Origin": self.origin, "Cookie": self.cookie} | headers
        connection.connect()
        with contextlib.suppress(ConnectionError, ssl.SSLEOFError):  # the console rejects a large body before its end
            connection.request(verb, path, body=body, headers={name: value for name, value in sent.items() if value})
        response = connection.getresponse()
        if (cookie := response.getheader("set-cookie")) is not None:
            self.cookie = cookie.partition(";")[0]
            self.cookie_flags = cookie
        found = response.status, response.read()
        connection.close()
        return found

    def pair(self, code: str) -> Any:
        """Pair with a code, and return the answer."""
        return json.loads(self.ask("POST", "/pair", code)[1])

    def socket(self, **headers: str) -> ClientConnection:
        """Open the page's socket."""
        sent = {"Origin": self.origin, "Cookie": self.cookie} | headers
        origin = Origin(sent.pop("Origin"))
        return connect(
            f"wss://{self.host}:{self.port}/ws",
            origin=origin,
            additional_headers=sent,
            ssl=untrusting(),
            proxy=None,
            open_timeout=30,
            close_timeout=1,  # the answer to the closing comes after messages that nobody takes, so do not wait for it
            source_address=self.source,
        )


def network_port(console: ConsoleProcess) -> int:
    """Return the network port of a console with `--lan`."""
    return int(find_line(console, r"On the network: https://.*:(\d+)"))


def first_code(console: ConsoleProcess) -> str:
    """Return the pairing code that the console printed."""
    return find_line(console, r"type (\w{4}-\w{4})$")


def find_line(console: ConsoleProcess, pattern: str) -> str:
    """Return the first group of the pattern in a line that the console printed."""

    def found() -> str | None:
        console.lines.extend(console.process.lines())
        return next((match[1] for line in console.lines if (match := re.search(pattern, line))), None)

    return str(wait_for(found, pattern))
