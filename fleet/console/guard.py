"""Decides which requests the console answers, on http and on the WebSocket. A pure ASGI middleware.

Starlette's BaseHTTPMiddleware never sees a WebSocket, so this is none.
"""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final

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
"""The only POST without a cookie: a stop must not fail because a cookie is old. Host and Origin are checked."""

PERSON: Final = "fleet.person"
"""Where the scope of a request from the network has its `PagePerson`."""


class Guard:
    """Passes requests of our own pages to the app, and refuses all others.

    hosts: the allowed values of Host, as `127.0.0.1:7448`. token: the value of the cookie. on_refusal: called with
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
            await _refuse(scope, receive, send, words)
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

    def _has_cookie(self, headers: dict[str, str]) -> bool:
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return False
        return morsel is not None and hmac.compare_digest(morsel.value.encode(), self._token.encode())

    def _new_cookie(self, scope: Scope, headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
        if scope["path"] not in COOKIE_PATHS or self._has_cookie(headers):
            return []
        return [(b"set-cookie", f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict".encode())]


def _headers(scope: Scope) -> dict[str, str]:
    """Return the headers by name. Of a repeated header, which no browser sends here, all values must be allowed."""
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
