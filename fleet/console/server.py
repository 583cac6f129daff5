"""Serves the console on loopback: the page's files, STOP by fetch, and one WebSocket for each page."""

import asyncio
import logging
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from fleet.aio import Fleet
from fleet.console.console import Console, TooManyPages
from fleet.console.guard import PERSON, STOP_PATH, App, Guard
from schemas.bus import LARGEST_PAYLOAD
from schemas.process import signals

STATIC: Final = Path(__file__).parent / "static"
DEFAULT_PORT: Final = 7480
"""A port near that of the bus (7447). Fleets of other names take those in between."""
LOOPBACK: Final = "127.0.0.1"
MAX_MESSAGE_BYTES: Final = 16_384
"""Maximum size of a page's message."""
_MAX_STOP_ID_LENGTH: Final = 64
_PLAN_MESSAGE_ROOM: Final = 1024
"""Room for what a message contains beside the text of a plan, bytes."""
_TRY_AGAIN_LATER: Final = 1013
_CLOSE_TIMEOUT_S: Final = 2.0
"""Timeout for open connections when the console ends."""

log = logging.getLogger("fleet")


class ConsoleServer(uvicorn.Server):
    """Uvicorn without its signal handlers, which would cancel the stops at the end."""

    def end(self) -> None:
        """Close all pages and return from `serve`."""
        self.should_exit = True

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to `serve`."""
        yield


def listen(port: int) -> socket.socket:
    """Return a listening socket on loopback. Raises OSError if the port is in use."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen()  # the address is printed before uvicorn accepts
    except OSError:
        listener.close()
        raise
    return listener


def guarded_app(console: Console, port: int) -> App:
    """Return the ASGI app of a console on this port."""
    hosts = frozenset(f"{host}:{port}" for host in (LOOPBACK, "localhost"))
    return Guard(
        _app(console),
        hosts=hosts,
        cookie=f"fleet_console_{port}",  # a browser sends cookies to all ports of a host
        token=secrets.token_urlsafe(32),
        on_refusal=log.warning,
    )


async def serve(fleet: Fleet, listener: socket.socket, on_ready: Callable[[], object]) -> None:
    """Serve until Ctrl-C or SIGTERM. Then stop the cars that pages drive."""
    console = Console(fleet)
    config = uvicorn.Config(
        guarded_app(console, listener.getsockname()[1]),
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_max_queue=64,
        log_config=None,
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=int(_CLOSE_TIMEOUT_S),
    )
    server = ConsoleServer(config)
    signals.calls_in(asyncio.get_running_loop(), lambda _: server.end())
    running = asyncio.ensure_future(console.run())
    running.add_done_callback(lambda _: server.end())
    try:
        on_ready()
        await server.serve(sockets=[listener])
    finally:
        await console.close()
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


def _app(console: Console) -> Starlette:
    async def page(_: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def hello(_: Request) -> Response:
        return PlainTextResponse("")

    async def stop(request: Request) -> Response:
        stop_id = request.query_params.get("id", "")[:_MAX_STOP_ID_LENGTH]
        console.stop_all(stop_id or secrets.token_hex(8))
        return Response(status_code=204)

    async def check_plan(request: Request) -> Response:
        return await _answer_plan(request, console.operator.check_plan)

    async def set_plan(request: Request) -> Response:
        return await _answer_plan(request, console.operator.set_plan)

    async def connect(socket_: WebSocket) -> None:
        await socket_.accept()
        try:
            async with _joined(console, socket_) as on_text:
                while True:
                    on_text(await socket_.receive_text())
        except TooManyPages:
            await socket_.close(_TRY_AGAIN_LATER, "too many pages are open")
        except (WebSocketDisconnect, KeyError):  # KeyError: a binary message
            with suppress(RuntimeError):
                await socket_.close()

    return Starlette(
        routes=[
            Route("/", page),
            Route("/hello", hello),
            Route(STOP_PATH, stop, methods=["POST"]),
            Route("/plan/check", check_plan, methods=["POST"]),
            Route("/plan/set", set_plan, methods=["POST"]),
            WebSocketRoute("/ws", connect),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
    )


async def _answer_plan(request: Request, ask: Callable[[str], Awaitable[tuple[bool, str]]]) -> Response:
    """Answer a request with the text of a plan."""
    text = await _read_text(request)
    if text is None:
        return JSONResponse({"ok": False, "words": f"The plan has more than {LARGEST_PAYLOAD // 1024} KiB."}, 413)
    ok, words = await ask(text)
    return JSONResponse({"ok": ok, "words": words})


async def _read_text(request: Request) -> str | None:
    """Return the body of a request. None if it is too large for the bus: the rest is not read."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LARGEST_PAYLOAD - _PLAN_MESSAGE_ROOM:
            return None
    return body.decode("utf-8", "replace")


@asynccontextmanager
async def _joined(console: Console, socket_: WebSocket) -> AsyncIterator[Callable[[str], None]]:
    """Join a page to the console. Yield the function that takes its messages."""
    page = console.add_page(socket_.send_text, socket_.scope.get(PERSON))
    sending = asyncio.ensure_future(page.run())

    def on_sent(task: "asyncio.Task[None]") -> None:
        if not task.cancelled() and task.exception() is not None:  # the page does not read, or has gone
            console.remove_page(page)
            console.operator.spawn(_close(socket_))

    sending.add_done_callback(on_sent)
    try:
        yield lambda text: console.on_text(page, text)
    finally:
        console.remove_page(page)
        sending.cancel()


async def _close(socket_: WebSocket) -> None:
    with suppress(RuntimeError, WebSocketDisconnect):
        await socket_.close()
