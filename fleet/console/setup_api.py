"""Answers the requests of pages that set up a fleet: scan, make a car blink, write its link into the fleet file.

Only pages on this computer may set up a fleet. In an existing file, links are changed and new cars are added, and
nothing else changes.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from fleet.aio import Fleet
from fleet.console.page_requests import PageMessage
from fleet.console.request_filter import PERSON
from fleet.console.sessions_api import read_body, refuse
from fleet.fleet_links import may_be_same, parse_fleet_link
from fleet.fleetfile.editor import set_link
from fleet.fleetfile.fleet_file import default_color, parse_fleet, read_fleet
from fleet.fleetfile.fleet_model import validate_car_name, validate_link, validate_platform
from fleet.fleetfile.scan_process import ScanFailed, scan
from fleet.fleetfile.template import NewCar, format_new_file
from fleet.supervisor.temporary_gateway import temporary_gateway
from schemas.atomic_file import write_atomically
from schemas.platform_name import AUTO
from schemas.yaml_document.document import read_text

MAX_SETUP_LINKS: Final = 64
"""Maximum number of links or cars in one request."""


class SetupApi:
    """Answers the set-up requests. `file` is the fleet file, which need not exist."""

    def __init__(self, fleet: Fleet, file: Path) -> None:
        self._fleet = fleet
        self._file = file
        self._busy = asyncio.Lock()
        """Held during a request, because a scan and a gateway cannot use the same port at once."""
        self._blinks = 0

    def routes(self) -> list[Route]:
        """Return the routes of the requests."""
        steps = {"file": self._show, "scan": self._scan, "blink": self._blink, "write": self._write}
        return [Route(f"/setup/{name}", self._answer(work), methods=["POST"]) for name, work in steps.items()]

    def _answer(self, work: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            if PERSON in request.scope:
                return refuse("Cars are set up on the computer of the console only.")
            try:
                fields = PageMessage.of(await read_body(request) or "{}").fields
                return JSONResponse({"ok": True, **await asyncio.to_thread(work, fields)})
            except (ValueError, ScanFailed, OSError) as error:  # BadFile and CannotEdit are ValueErrors
                return refuse(str(error))

        async def alone(request: Request) -> Response:
            async with self._busy:
                return await answer(request)

        return alone

    def _read_links(self) -> Mapping[str, str]:
        """Return the link of each car in the file, by the car's name. If a car has no link, the text is empty."""
        if not self._file.exists():
            return {}
        file = read_fleet(self._file, unbound=True)
        return {name: car.link for name, car in {**file.cars, **file.unlinked}.items()}

    def _show(self, _: Mapping[str, Any]) -> dict[str, Any]:
        exists = self._file.exists()
        return {"file": str(self._file), "exists": exists, "cars": [*self._read_links().items()], "words": ""}

    def _scan(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        links = _texts(fields.get("links", []))
        for link in links:
            validate_link(link)
        links_in_file = self._read_links()
        found = [
            {
                "url": each.url,
                "verdict": each.verdict,
                "words": each.words,
                "platform": each.platform,
                "car": _find_car_at(each.url, links_in_file),
            }
            for each in scan(links, None)
        ]
        return {"found": found, "words": "" if found else "No car was found. Is it on? Is another program at its port?"}

    def _blink(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Make the car at a link blink, through its own gateway if it has one, else through a temporary gateway."""
        link = validate_link(str(fields.get("url", "")))
        client = self._fleet.sync
        car = _find_car_at(link, self._read_links())
        if car and car in client.cars():
            outcome = client.car(car).find()
        else:
            self._blinks += 1
            errors: list[str] = []
            with temporary_gateway(client, f"setup-{self._blinks}", link, errors.append) as name:
                if name is None:
                    return {"ok": False, "words": errors[-1]}
                outcome = client.car(name).find()
        return {"ok": outcome.ok, "words": outcome.words or outcome.reason or outcome.phase}

    def _write(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Write the links of cars into the file. With `replace`, overwrite other links of these cars."""
        entries = fields.get("cars")
        if not isinstance(entries, list) or not entries:
            raise ValueError("Give at least one car a name.")
        if len(entries) > MAX_SETUP_LINKS:
            raise ValueError(f"{len(entries)} cars are too many: set up at most {MAX_SETUP_LINKS} at once.")
        cars = [_new_car(each, index) for index, each in enumerate(entries)]
        if len({car.name for car in cars}) < len(cars):
            raise ValueError("Two cars have the same name.")
        links = self._read_links()
        other_links = [
            f"{car.name} is at {links[car.name]}" for car in cars if links.get(car.name, car.link) not in ("", car.link)
        ]
        if other_links and fields.get("replace") is not True:
            return {"ok": False, "confirm": True, "words": f"In the file, {'; '.join(other_links)}."}
        if self._file.exists():
            text = read_text(self._file)
            for car in cars:
                text = set_link(text, self._file, car.name, car.link)
        else:
            text = format_new_file(cars)
            parse_fleet(text, self._file)
        write_atomically(self._file.resolve(), text.encode())
        names = ", ".join(car.name for car in cars)
        return {"words": f"{self._file} now has {names}. Type: fleet reload, or fleet up"}


def _new_car(entry: Any, index: int) -> NewCar:
    fields = entry if isinstance(entry, dict) else {}
    name, link, platform = (str(fields.get(field, "")) for field in ("name", "url", "platform"))
    name = validate_car_name(name)
    return NewCar(name, validate_link(link), validate_platform(platform or AUTO), default_color(name, index))


def _find_car_at(url: str, links: Mapping[str, str]) -> str:
    """Return the name of the car in the file that may be at this link, or an empty text."""
    link = parse_fleet_link(url)
    return next((car for car, each in links.items() if each and may_be_same(link, parse_fleet_link(each))), "")


def _texts(values: Any) -> Sequence[str]:
    if not isinstance(values, list) or len(values) > MAX_SETUP_LINKS or not all(isinstance(e, str) for e in values):
        raise ValueError(f"`links` is not a list of at most {MAX_SETUP_LINKS} texts")
    return values
