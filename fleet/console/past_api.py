"""Requests of the pages for the past: the lanes of a recording, and the state of everything at a moment of a recording.

Every person who may see the page may look back, a guest may not. Two processes read the recordings (past_worker.py),
one for lanes and one for moments. The lanes of an hour take seconds, and a jump to a moment must not wait for them.
"""

import asyncio
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from fleet.console.page_requests import BadPageMessage, PageMessage
from fleet.console.plot_buffer import series_of
from fleet.console.plot_feed import MAX_PLOT_S
from fleet.console.request_filter import PERSON
from fleet.console.session_files import NotInFolder, session_path
from fleet.console.sessions_api import read_body, refuse
from fleet.console.worker import TooManyQuestions, Worker
from schemas.keys import is_name

LANES_TIMEOUT_S: Final = 120.0
"""Timeout of the lanes of a recording. An hour of twenty cars takes 3 s, as does a day of three cars. On a busy
processor both take ten times as long, because the processes have a low priority."""
MOMENT_TIMEOUT_S: Final = 20.0
"""Timeout of a moment. It takes 0.2 s with twenty cars, and ten times as long on a busy processor. The start of the
process takes up to 10 s."""
IDLE_READER_S: Final = 300.0
"""Time without a question after which the processes end. A person may look at the result of a jump for minutes."""
MAX_OPEN_LOOKS: Final = 2
"""Maximum number of questions of one person that wait. A page asks for only one moment at a time."""
_MAX_MS: Final = 2**53
"""JavaScript represents every whole number up to this one exactly."""
_TOO_MANY: Final = "Other looks of this person at recordings have no answer yet. Try again in a few seconds."


class PastApi:
    """The routes. `place` is the sessions folder. `colors` returns the color of each car."""

    def __init__(self, place: Path, colors: Callable[[], Mapping[str, str]]) -> None:
        self._place = place
        self._colors = colors
        self._lanes, self._moments = (
            Worker("fleet.console.past_worker", timeout_s=timeout_s, idle_s=IDLE_READER_S, max_open=MAX_OPEN_LOOKS)
            for timeout_s in (LANES_TIMEOUT_S, MOMENT_TIMEOUT_S)
        )

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/past/{name}", self._answer_lanes),
            Route("/past/{name}/at", self._answer_moment, methods=["POST"]),
        ]

    async def close(self) -> None:
        """End the processes."""
        await self._lanes.close()
        await self._moments.close()

    async def _answer_lanes(self, request: Request) -> Response:
        return await self._ask(self._lanes, request, {})

    async def _answer_moment(self, request: Request) -> Response:
        try:
            question = moment_question(await read_body(request))
        except BadPageMessage as error:
            return refuse(str(error), 400)
        return await self._ask(self._moments, request, question | {"colors": dict(self._colors())})

    async def _ask(self, worker: Worker, request: Request, question: Mapping[str, Any]) -> Response:
        try:
            path = await asyncio.to_thread(session_path, self._place, request.path_params["name"])
        except (NotInFolder, OSError) as error:
            return refuse(str(error), 404)
        person = request.scope.get(PERSON)
        try:
            found = await worker.ask({"path": str(path.absolute()), **question}, person and person.name)
        except TooManyQuestions:
            return refuse(_TOO_MANY, 429)
        return JSONResponse(found) if found is not None else refuse("The recording could not be read in time.")


def moment_question(text: str) -> dict[str, Any]:
    """Return the checked question of a page: a moment, a car with its details, and what is plotted before it.

    Raises BadPageMessage.
    """
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        raise BadPageMessage("this is not JSON") from None
    if not isinstance(fields, dict):
        raise BadPageMessage("this is not a question about a moment")
    at_ms, span_s = _number(fields, "at_ms", _MAX_MS), _number(fields, "span_s", MAX_PLOT_S)
    car = fields.get("car") or ""
    if not isinstance(car, str) or (car and not is_name(car)):
        raise BadPageMessage("`car` is not the name of a car")
    series = series_of(PageMessage({"series": fields.get("series", [])}))
    return {
        "at_ms": int(at_ms),
        "car": car,
        "span_s": span_s,
        "map": fields.get("map") is True,
        "plan": fields.get("plan") is True,
        "series": [(each.car, each.topic, each.field) for each in series],
    }


def _number(fields: Mapping[str, Any], name: str, most: float) -> float:
    """Return a number from 0 to `most`. Raises BadPageMessage."""
    value = fields.get(name, 0)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= most:  # also for NaN
        raise BadPageMessage(f"{name} is not 0 to {most}")
    return float(value)
