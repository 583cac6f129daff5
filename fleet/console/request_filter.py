"""Decides which requests the console answers, on http and on the WebSocket. A pure ASGI middleware.

Starlette's BaseHTTPMiddleware never sees a WebSocket, so this class does not use it.
"""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final

from fleet.console.people_book import CookieState, PairedDevice

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

CSP: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types"
)
_HEADERS: Final = (
    (b"content-security-policy", CSP.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-cache"),
)
COOKIE_PATHS: Final = ("/", "/hello")
"""Where a page gets its cookie. `/hello` renews it after a restart of the console."""
STOP_PATH: Final = "/stop"
"""A POST that needs no cookie on this computer, and from the network no valid one: that of an expired pairing will do.
An old cookie must not make a stop fail. Host and Origin are checked."""

PERSON: Final = "fleet.person"
"""Where the scope of a request from the network has its `PagePerson`."""
DEVICE: Final = "fleet.device"
"""Where the scope of a request from the network has the id of its `PairedDevice`."""
PAIR_PATH: Final = "/pair"
PUBLIC_PATHS: Final = frozenset({PAIR_PATH, "/static/pair.js", "/static/style.css"})
"""Everything that an unpaired device can read."""
_HTTPS_PORT: Final = 443


class Guard:
    """Passes requests of our own pages to the app, and refuses all others.

    hosts: the allowed values of Host, as `127.0.0.1:7480`. token: the value of the cookie. `on_refusal` is called with
    words for the log.
    """

    def __init__(
        self, app: App, *, hosts: frozenset[str], cookie: str, token: str, on_refusal: Callable[[str], object]
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._origins = frozenset(f"http://{host}" for host in hosts)
        self._cookie = cookie
        self._token = token
        self._on_refusal = on_refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or one WebSocket."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = _headers(scope)
        if words := self._refusal(scope, headers):
            self._on_refusal(f"{scope['type']} {scope['path']!r} refused: {words}")
            await self._refuse(scope, receive, send, words)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *_HEADERS, *self._new_cookie(scope, headers)]
            await send(message)

        await self._app(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> str:
        """Return why a request is refused. Empty if it is allowed."""
        if headers.get("host", "") not in self._hosts:
            return "another Host (open the address that the console printed)"
        reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        if reads:
            return ""
        if headers.get("origin", "") not in self._origins:
            return "another Origin (only the console's own pages may do this)"
        if scope["path"] != STOP_PATH and not self._has_cookie(headers):
            return "no valid cookie (reload the page)"
        return ""

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, words: str) -> None:
        await _refuse(scope, receive, send, words)

    def _has_cookie(self, headers: dict[str, str]) -> bool:
        value = cookie_value(headers, self._cookie)
        return value is not None and hmac.compare_digest(value.encode(), self._token.encode())

    def _new_cookie(self, scope: Scope, headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
        if scope["path"] not in COOKIE_PATHS or self._has_cookie(headers):
            return []
        return [(b"set-cookie", f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict".encode())]


class NetworkGuard(Guard):
    """The filter for the network: only paired devices pass. Any other device can read only the page on which it pairs.

    `names` returns the host names of this computer. `device_of` returns the device of a cookie, and what the cookie
    may do. `on_device` is called for each request that passes with a cookie, with its address and its device.
    """

    def __init__(
        self,
        app: App,
        *,
        names: Callable[[], frozenset[str]],
        cookie: str,
        device_of: Callable[[str], tuple[PairedDevice | None, CookieState]],
        on_device: Callable[[tuple[str, int], PairedDevice], object],
        on_refusal: Callable[[str], object],
    ) -> None:
        super().__init__(app, hosts=frozenset(), cookie=cookie, token="", on_refusal=on_refusal)
        self._names = names
        self._device_of = device_of
        self._on_device = on_device

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> str:
        host = headers.get("host", "").lower()
        # A stranger's page, whose host name leads to this computer, sends that name as Host (DNS rebinding). The
        # address at which the connection arrived is ours, and no host name looks like an IP address.
        address, port = scope["server"]
        ours = {f"{name}:{port}" for name in (*self._names(), address)}
        if port == _HTTPS_PORT:
            ours |= {*self._names(), address}
        if host not in ours:
            return "another Host (open the address that the console printed)"
        method = scope.get("method", "")
        reads = scope["type"] == "http" and method in ("GET", "HEAD")
        if reads and scope["path"] in PUBLIC_PATHS:
            return ""
        if not reads and headers.get("origin", "") != f"https://{host}":
            return "another Origin (only the console's own pages may do this)"
        if scope["type"] == "http" and scope["path"] == PAIR_PATH:
            return ""
        device, state = self._device_of(cookie_value(headers, self._cookie) or "")
        stops = scope["type"] == "http" and scope["path"] == STOP_PATH and method == "POST"
        if device is None or (state != "valid" and not stops):
            expired = "'s pairing has expired; only STOP works (open /pair)"  # the page looks for "expired"
            return f"this device{' is not paired (open /pair)' if device is None else expired}"
        if device.person.is_guest and not stops and not _may_guest_ask(scope, method):
            return "a guest watches and stops (a lead assigns this device on the page Board)"
        scope[PERSON], scope[DEVICE] = device.person, device.id
        self._on_device(tuple(scope["client"]), device)
        return ""

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, words: str) -> None:
        if (scope["type"], scope["path"], words.startswith("this device")) != ("http", "/", True):
            await _refuse(scope, receive, send, words)
            return
        headers = [(b"location", PAIR_PATH.encode()), (b"content-length", b"0"), *_HEADERS]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})

    def _new_cookie(self, scope: Scope, headers: dict[str, str]) -> list[tuple[bytes, bytes]]:  # noqa: ARG002 - Guard's signature
        return []  # only a pairing code leads to a cookie


def _may_guest_ask(scope: Scope, method: str) -> bool:
    """Return True for paths that a device which nobody has assigned yet may read: the live page, but no recording."""
    if scope["type"] == "websocket":
        return True
    path = scope["path"]
    return method in ("GET", "HEAD") and (path in (*COOKIE_PATHS, "/people") or path.startswith("/static/"))


def cookie_value(headers: dict[str, str], name: str) -> str | None:
    """Return the value of a cookie, or None if there is none."""
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return None
    return None if morsel is None else morsel.value


def _headers(scope: Scope) -> dict[str, str]:
    """Return the headers by name. No browser repeats a header. If one is repeated, all its values must be allowed."""
    found: dict[str, str] = {}
    for name, value in scope["headers"]:
        key = name.decode("latin-1")
        text = value.decode("latin-1")
        found[key] = f"{found[key]}, {text}" if key in found else text
    return found


async def _refuse(scope: Scope, receive: Receive, send: Send, words: str) -> None:
    if scope["type"] == "websocket":
        await receive()  # websocket.connect
        await send({"type": "websocket.close", "code": 1008, "reason": words})
        return
    body = f"{words}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 403, "headers": [*headers, *_HEADERS]})
    await send({"type": "http.response.body", "body": body})
