"""The routes that pair devices, list them and revoke them."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from fleet.console.guess_limit import TooManyGuesses, WrongCode
from fleet.console.page_requests import BadPageMessage, PageMessage
from fleet.console.people_book import ClassFull, PagePerson
from fleet.console.request_body import read_text
from fleet.console.request_filter import PAIR_PATH, PERSON, Scope
from schemas.words import Rank

if TYPE_CHECKING:  # only `--lan` needs its packages
    from fleet.console.network_console import Lan

PAIR_PAGE: Final = Path(__file__).parent / "static" / "pair.html"
_MAX_BODY_BYTES: Final = 1024
_MAX_DEVICE_LENGTH: Final = 256


def pair_routes(lan: "Lan") -> list[Route]:
    """Return the routes for devices that are not paired."""

    async def page(_: Request) -> Response:
        return FileResponse(PAIR_PAGE)

    async def pair(request: Request) -> Response:
        code = await read_text(request, _MAX_BODY_BYTES)
        if request.client is None or code is None:
            return _failure("This is not a pairing code.", 400)
        device = request.headers.get("user-agent", "")[:_MAX_DEVICE_LENGTH]
        before = request.cookies.get(lan.cookie, "")
        try:
            cookie, person = await lan.pairing.pair(code, (request.client.host, request.client.port), device, before)
        except ClassFull as error:
            return _failure(str(error), 409)
        except WrongCode as error:
            words, wait_s = "This code is wrong, used or too old.", math.ceil(error.wait_s)
            if wait_s == 0:
                return _failure(words, 403)
            words = f"{words} Wait {wait_s} s before the next try."
            if isinstance(error, TooManyGuesses):
                words = f"Too many wrong codes came from this device's address. Try again in {wait_s} s."
            return _failure(words, 429, {"retry-after": str(wait_s)})
        return JSONResponse({"ok": True, "name": person.name}, headers={"set-cookie": lan.set_cookie(cookie)})

    return [Route(PAIR_PATH, page), Route(PAIR_PATH, pair, methods=["POST"])]


def people_routes(lan: "Lan | None") -> list[Route]:
    """Return the routes that list and change paired devices, for pages on this computer and for leads.

    Other pages learn that they may not.
    """

    async def people(request: Request) -> Response:
        may_pair = _may_pair(request.scope)
        return JSONResponse({"may_pair": may_pair, "lan": lan.as_dict() if lan is not None and may_pair else None})

    async def change(request: Request) -> Response:
        if lan is None:
            return _failure("This console serves its own computer only. Start it with --lan.", 409)
        if not _may_pair(request.scope):
            return _failure("Only the console's own computer or a lead may do this.", 403)
        text = await read_text(request, _MAX_BODY_BYTES)
        try:
            message = PageMessage.of(text or "")
            if message.kind == "revoke":
                gone = await lan.revoke([message.text("id")])
                return JSONResponse({"ok": bool(gone)})
            if message.kind == "open_class":
                opened = await lan.pairing.open_class(lan.address)
                return JSONResponse({"ok": True, **opened, "fingerprint": lan.certificate.fingerprint})
            if message.kind == "close_class":
                await lan.pairing.close_class()
                return JSONResponse({"ok": True})
            if message.kind == "assign":
                await lan.assign(message.text("id"), PagePerson(message.text("name")))
                return JSONResponse({"ok": True})
            if message.kind == "pair":
                person = PagePerson(message.text("name"), message.text("rank"))
                return JSONResponse({"ok": True, **await lan.pairing.offer(person, lan.address)})
            return _failure(f'There is no request "{message.kind}".', 400)
        except (BadPageMessage, ValueError) as error:
            return _failure(str(error), 400)
        except OSError as error:
            return _failure(f"The list of people cannot be written: {error.strerror}.", 500)

    return [Route("/people", people), Route("/people", change, methods=["POST"])]


def _may_pair(scope: Scope) -> bool:
    is_here = PERSON not in scope  # a page on this computer needs no pairing
    return is_here or scope[PERSON].rank == Rank.LEAD


def _failure(words: str, status: int, headers: dict[str, Any] | None = None) -> Response:
    return JSONResponse({"ok": False, "words": words}, status, headers)
