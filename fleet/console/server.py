"""Serves the console: the page's files, STOP by fetch, and one WebSocket for each page."""

import asyncio
import gc
import logging
import secrets
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import uvicorn
from msgspec.structs import replace
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from fleet.aio import Fleet
from fleet.client.commands import stop_request
from fleet.console.budgets import TOO_MANY_PLANS, TOO_MUCH, page_budget
from fleet.console.console import Console, TooManyPages
from fleet.console.fair_socket import FairWebSocket
from fleet.console.hold_to_drive import TOO_LATE
from fleet.console.log_rate import LogRate
from fleet.console.page_requests import is_stop
from fleet.console.people_book import PagePerson
from fleet.console.people_routes import pair_routes, people_routes
from fleet.console.plan_view import plan_name
from fleet.console.request_body import read_text
from fleet.console.request_filter import DEVICE, PERSON, STOP_PATH, App, Guard, NetworkGuard, Receive, Scope, Send
from fleet.console.tls_entrance import Entrance
from fleet.console.worker import TooManyQuestions
from fleet.examples import EXAMPLES
from schemas.bus import LARGEST_PAYLOAD, LOOPBACK, BusError
from schemas.process import signals

if TYPE_CHECKING:  # only `--lan` needs its packages
    from fleet.console.network_console import Lan

STATIC: Final = Path(__file__).parent / "static"
MAX_MESSAGE_BYTES: Final = 16_384
"""Maximum size of a page's message."""
HELLO: Final = "fleet console"
"""The answer to `/hello`. A second console recognizes the first one by it."""
STOP_NOT_TAKEN: Final = "NOT STOPPED yet: the fleet's bus does not answer. If a car moves, go to the car."
"""Answer to a STOP that no gateway has answered yet."""
_MAX_STOP_ID_LENGTH: Final = 64
_PLAN_MESSAGE_ROOM: Final = 1024
"""Bytes that a message may have besides the text of a plan."""
_LAST_READ_MESSAGES: Final = 10_000
"""When a page has exceeded its budget, up to this number of its messages are searched for stops. One read, 256 KiB,
holds 8,000 of the smallest messages."""
_LAST_READ_S: Final = 2.0
"""Timeout of this search. It takes 0.4 s, or several times as long if other pages flood the console, too."""
NORMAL: Final = 1000
TRY_AGAIN_LATER: Final = 1013
NOT_PAIRED: Final = 4001
"""Close code of a page whose device was revoked or whose pairing has expired. The page shows this at once."""
SENT_TOO_MUCH: Final = 4008
"""Close code of a page that exceeded its budget. The page shows the reason, and waits before it connects again."""
_CLOSE_TIMEOUT_S: Final = 2.0
"""Timeout for open connections when the console ends."""

_LOGGERS: Final = ("fleet", "asyncio", "uvicorn.error")
"""Loggers that a flood of connections could fill: asyncio logs each write to a TLS connection that has gone."""

log = logging.getLogger("fleet")


class ConsoleServer(uvicorn.Server):
    """Uvicorn without its signal handlers, because they would cancel the stops at the end."""

    def end(self) -> None:
        """Close all pages and return from `serve`."""
        self.should_exit = True

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to `serve`."""
        yield


class NetworkServer(ConsoleServer):
    """The server for the network. Its connections come from an entrance, which lets them in at a bounded rate."""

    def __init__(self, config: uvicorn.Config, lan: "Lan") -> None:
        super().__init__(config)
        self._lan = lan
        self._entrance: Entrance | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:  # noqa: ARG002 - uvicorn's signature
        """Begin to accept. uvicorn itself would begin TLS with all waiting connections at once."""
        await super().startup(sockets=[])

        def make_protocol() -> asyncio.Protocol:
            state = self.lifespan.state
            protocol: asyncio.Protocol = self.config.http_protocol_class(  # type: ignore[call-arg]
                config=self.config, server_state=self.server_state, app_state=state
            )
            return protocol

        self._entrance = Entrance(self._lan.listener, self._lan.context, make_protocol)
        self._entrance.open()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept no more connections, and end those that are open."""
        if self._entrance is not None:
            self._entrance.close()
        await super().shutdown(sockets)


def listen(port: int) -> socket.socket:
    """Return a listening socket on loopback. Raises OSError if the port is in use."""
    # asyncio sets TCP_NODELAY only if the socket names its protocol. Without TCP_NODELAY, a message may wait 40 ms.
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen()  # the address is printed before uvicorn accepts
    except OSError:
        listener.close()
        raise
    return listener


def guarded_app(console: Console, port: int, lan: "Lan | None" = None) -> App:
    """Return the ASGI app of a console on this port of loopback."""
    hosts = frozenset(f"{host}:{port}" for host in (LOOPBACK, "localhost"))
    return Guard(
        _app(console, lan),
        hosts=hosts,
        cookie=f"fleet_console_{port}",  # the name has the port, because a browser sends cookies to all ports of a host
        token=secrets.token_urlsafe(32),
        on_refusal=log.warning,
    )


def network_app(console: Console, lan: "Lan") -> App:
    """Return the ASGI app for the network."""
    return NetworkGuard(
        _app(console, lan, pair_routes(lan)),
        names=lambda: lan.names,
        cookie=lan.cookie,
        device_of=lan.device_of,
        on_device=lan.on_device,
        on_refusal=lan.on_refusal,
    )


def _config(app: App) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        ws=FairWebSocket,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_max_queue=64,
        log_config=None,
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=int(_CLOSE_TIMEOUT_S),
    )


async def serve(
    fleet: Fleet,
    listener: socket.socket,
    on_ready: Callable[[], object],
    place: Path,
    file: Path,
    lan: "Lan | None" = None,
) -> None:
    """Serve until Ctrl-C or SIGTERM. Then stop the cars that pages drive.

    place: the sessions folder. file: the fleet file. lan: the part that serves the network, too, or None.
    """
    rate = LogRate()
    for name in _LOGGERS:
        logging.getLogger(name).addFilter(rate)
    console = Console(fleet, place, file)
    servers = [(ConsoleServer(_config(guarded_app(console, listener.getsockname()[1], lan))), listener)]
    running = [asyncio.ensure_future(console.run())]
    if lan is not None:
        config = _config(network_app(console, lan))
        config.load()
        config.ssl = lan.context
        servers.append((NetworkServer(config, lan), lan.listener))
        running.append(asyncio.ensure_future(lan.run(lambda: console.people)))

    def end(_: object) -> None:
        for server, _listener in servers:
            server.end()

    signals.calls_in(asyncio.get_running_loop(), end)
    for each in running:
        each.add_done_callback(end)
    try:
        on_ready()
        # Imported objects live as long as the process. Freeze them, so that the garbage collections of `tls_entrance`
        # skip them.
        gc.collect()
        gc.freeze()
        await asyncio.gather(*(server.serve(sockets=[listens]) for server, listens in servers))
    finally:
        await console.close()
        for each in running:
            each.cancel()
            with suppress(asyncio.CancelledError):
                await each


def _app(console: Console, lan: "Lan | None", more: Sequence[Route] = ()) -> App:
    async def page(_: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def hello(_: Request) -> Response:
        return PlainTextResponse(HELLO)

    async def stop(request: Request) -> Response:
        stop_id = request.query_params.get("id", "")[:_MAX_STOP_ID_LENGTH]
        person = request.scope.get(PERSON)
        # A stop must have the name of the person who stops. Under a lead's name, the person could not drive the cars
        # afterwards.
        named = replace(stop_request(), sender=console.sender_of(person))
        console.stop_all(stop_id, console.operator_of(person), named)
        if not await console.is_stop_taken():  # after this answer, the page sends its STOP again
            return JSONResponse({"ok": False, "words": STOP_NOT_TAKEN}, 503)
        return Response(status_code=204)

    async def check_plan(request: Request) -> Response:
        return await _answer_plan(request, console, console.plan.check)

    async def plan_examples(_: Request) -> Response:
        return JSONResponse({"ok": True, "examples": await asyncio.to_thread(example_plans)})

    async def set_plan(request: Request) -> Response:
        person = request.scope.get(PERSON)
        if words := console.management_refusal(person):
            return JSONResponse({"ok": False, "words": words}, 403)
        tick = request.query_params.get("n", "")
        if console.is_late(int(tick[:16]) if tick.isdecimal() else None):
            return JSONResponse({"ok": False, "words": TOO_LATE}, 408)
        return await _answer_plan(request, console, console.plan.set_plan)

    async def connect(socket_: WebSocket) -> None:
        await socket_.accept()
        person = socket_.scope.get(PERSON)
        # The budget is per device, so that another tablet of the same person is not slowed down.
        name, budget = person and person.name, page_budget()
        device = socket_.scope.get(DEVICE)
        if not console.budgets.may_open(device, time.monotonic()):
            await socket_.close(SENT_TOO_MUCH, TOO_MUCH)
            return
        try:
            async with _joined(console, socket_, lan) as on_text:
                while True:
                    text = await socket_.receive_text()
                    if not console.budgets.may_send(device, budget, time.monotonic()):
                        log.warning("a page of %s was closed: it sent too much", name or "this computer")
                        await _carry_out_stops(socket_, text, on_text)
                        await socket_.close(SENT_TOO_MUCH, TOO_MUCH)
                        return
                    if text:  # an empty text is a ping: it only uses the budget
                        on_text(text)
                    await asyncio.sleep(0)  # a page that floods must not keep the others waiting
        except TooManyPages as error:
            await socket_.close(TRY_AGAIN_LATER, str(error))
        except BusError:
            await socket_.close(TRY_AGAIN_LATER, "the bus cannot be reached")
        except (WebSocketDisconnect, KeyError, RuntimeError):  # a binary message; a socket that we have closed
            await _close(socket_)

    app = Starlette(
        routes=[
            Route("/", page),
            Route("/hello", hello),
            Route(STOP_PATH, stop, methods=["POST"]),
            Route("/plan/examples", plan_examples),
            Route("/plan/check", check_plan, methods=["POST"]),
            Route("/plan/set", set_plan, methods=["POST"]),
            *console.sessions.routes(),
            *console.setup.routes(),
            *console.past.routes(),
            *people_routes(lan),
            *more,
            WebSocketRoute("/ws", connect),
            # Compress only what is the same for everyone. A secret must not be compressed together with text that a
            # stranger chooses.
            Mount("/static", GZipMiddleware(StaticFiles(directory=STATIC))),
        ]
    )

    async def limited(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"] != STOP_PATH:
            # The budget is per device, so another tablet of the same person is not slowed down, and no stranger slows
            # down this computer.
            stranger = ("stranger", scope["client"][0]) if more else None
            if not console.budgets.may_ask(scope.get(DEVICE, stranger), time.monotonic()):
                await _too_much("This device asks for far more than a page does. Wait a few seconds.")(
                    scope, receive, send
                )
                return
        await app(scope, receive, send)

    return limited


def _too_much(words: str) -> Response:
    """Answer a request over its budget, without reading the rest of it."""
    return JSONResponse({"ok": False, "words": words}, 429, {"connection": "close"})


def example_plans() -> list[dict[str, str]]:
    """Return the names and texts of the plans that come with the package."""
    texts = (path.read_text("utf-8") for path in sorted((EXAMPLES / "plans").glob("*.yaml")))
    return [{"name": plan_name(text, ()), "text": text} for text in texts]


async def _answer_plan(
    request: Request, console: Console, ask: Callable[[str, PagePerson | None], Awaitable[dict[str, Any]]]
) -> Response:
    """Answer a request with the text of a plan."""
    person: PagePerson | None = request.scope.get(PERSON)
    may_check = console.budgets.may_check(person and person.name, time.monotonic())
    if not may_check or console.plan.checks.is_busy(person):
        return _too_much(TOO_MANY_PLANS)
    text = await read_text(request, LARGEST_PAYLOAD - _PLAN_MESSAGE_ROOM)
    if text is None:
        return JSONResponse({"ok": False, "words": f"The plan has more than {LARGEST_PAYLOAD // 1024} KiB."}, 413)
    try:
        answer = await ask(text, person)
    except TooManyQuestions:  # other checks of this person came while the body was read
        return _too_much(TOO_MANY_PLANS)
    return JSONResponse(answer)


@asynccontextmanager
async def _joined(console: Console, socket_: WebSocket, lan: "Lan | None") -> AsyncIterator[Callable[[str], None]]:
    """Join a page to the console. Yield the function that handles its messages."""
    page = await console.add_page(socket_.send_text, socket_.scope.get(PERSON), socket_.scope.get(DEVICE, ""))
    sending = asyncio.ensure_future(page.run())

    def end(code: int = NORMAL) -> None:
        console.remove_page(page)
        console.operator.spawn(_close(socket_, code))

    def on_sent(task: "asyncio.Task[None]") -> None:
        if not task.cancelled() and task.exception() is not None:  # the page has gone, or does not read
            end()

    def on_text(text: str) -> None:
        if from_network is None or from_network.is_current(socket_.scope):
            console.on_text(page, text)
        else:
            end(NOT_PAIRED)

    sending.add_done_callback(on_sent)
    from_network = lan if PERSON in socket_.scope else None
    try:
        with (
            nullcontext()
            if from_network is None
            else from_network.connected(socket_.scope, partial(end, NOT_PAIRED), end)
        ):
            yield on_text
    finally:
        console.remove_page(page)
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)


async def _carry_out_stops(socket_: WebSocket, text: str, on_text: Callable[[str], None]) -> None:
    """Carry out the stops among the messages that came after the budget was exceeded. Drop the rest."""
    with suppress(TimeoutError):
        async with asyncio.timeout(_LAST_READ_S):
            for _ in range(_LAST_READ_MESSAGES):
                if is_stop(text):
                    on_text(text)
                await asyncio.sleep(0)
                text = await socket_.receive_text()


async def _close(socket_: WebSocket, code: int = NORMAL) -> None:
    with suppress(RuntimeError, WebSocketDisconnect):
        await socket_.close(code)
