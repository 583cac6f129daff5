"""Foreign hosts, foreign origins, missing and guessed cookies: on http and on the WebSocket."""

import asyncio
from typing import Any

import pytest

from fleet.console.request_filter import Guard, Message, Receive, Scope, Send

PORT = 7448
HOSTS = frozenset({f"127.0.0.1:{PORT}", f"localhost:{PORT}"})
TOKEN = "t0ken"
OURS = {"host": f"127.0.0.1:{PORT}", "origin": f"http://127.0.0.1:{PORT}", "cookie": f"console={TOKEN}"}


async def _app(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def call(kind: str, path: str, headers: dict[str, str], method: str = "GET") -> list[Any]:
    """Return the messages that the guard sends for one request."""
    sent: list[Message] = []
    refusals: list[str] = []
    guard = Guard(_app, hosts=HOSTS, cookie="console", token=TOKEN, on_refusal=refusals.append)

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        sent.append(message)

    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    asyncio.run(guard({"type": kind, "path": path, "method": method, "headers": raw}, receive, send))
    assert bool(refusals) is (sent[0].get("status") == 403 or sent[0]["type"] == "websocket.close")
    return sent


def but(**changes: str | None) -> dict[str, str]:
    """Return our page's headers with these changes. None leaves a header out."""
    return {name: value for name, value in (OURS | changes).items() if value is not None}


FOREIGN = [
    but(host="evil.example"),
    but(host="evil.example:7448", origin="http://evil.example:7448"),  # DNS rebinding
    but(host="127.0.0.1"),
    but(host=None),
    but(host=f"127.0.0.1:{PORT}, evil.example"),
    but(origin="http://evil.example"),
    but(origin="http://127.0.0.1:8000"),
    but(origin=f"https://127.0.0.1:{PORT}"),
    but(origin="null"),
    but(origin=None),
    but(cookie=None),
    but(cookie="console=guess"),
    but(cookie="console="),
    but(cookie="console=\xff; \x00="),
    but(cookie="other=t0ken"),
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_foreign_socket_is_refused(headers: dict[str, str]) -> None:
    (first,) = call("websocket", "/ws", headers)
    assert (first["type"], first["code"]) == ("websocket.close", 1008)


@pytest.mark.parametrize("headers", FOREIGN)
def test_foreign_post_is_refused(headers: dict[str, str]) -> None:
    assert call("http", "/anything", headers, "POST")[0]["status"] == 403


@pytest.mark.parametrize("headers", [each for each in FOREIGN if each.get("cookie") == OURS["cookie"]])
def test_foreign_stop_is_refused(headers: dict[str, str]) -> None:
    assert call("http", "/stop", headers, "POST")[0]["status"] == 403


def test_stop_of_our_page_needs_no_cookie() -> None:
    assert call("http", "/stop", but(cookie=None), "POST")[0]["status"] == 200


def test_own_page_is_served_on_both_names_with_cookie() -> None:
    assert call("websocket", "/ws", OURS)[0]["type"] == "websocket.accept"
    for host in HOSTS:
        start = call("http", "/", {"host": host})[0]
        headers = dict(start["headers"])
        assert headers[b"set-cookie"] == b"console=t0ken; Path=/; HttpOnly; SameSite=Strict"
        assert b"unsafe" not in headers[b"content-security-policy"]
    assert b"set-cookie" not in dict(call("http", "/", OURS)[0]["headers"])
    assert b"set-cookie" not in dict(call("http", "/static/app.js", {"host": OURS["host"]})[0]["headers"])


@pytest.mark.parametrize("host", ["evil.example", "0.0.0.0:7448", ""])
def test_no_page_is_served_under_another_host(host: str) -> None:
    assert call("http", "/", {"host": host})[0]["status"] == 403
