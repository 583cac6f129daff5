"""Requests of the pages about recordings: the recorder, the list of sessions, verify, download, export, and Rerun.

A session of gigabytes must not delay a STOP. So lists, verify and exports run in separate processes with a low
priority, and threads read what is downloaded.
"""

import asyncio
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from fleet.aio import Fleet
from fleet.client.services import ask_recorder, why_unrecorded
from fleet.console.people_book import PagePerson
from fleet.console.request_body import read_start
from fleet.console.request_filter import PERSON
from fleet.console.session_files import NotInFolder, files_of, read_file, session_path, zip_files
from fleet.console.session_jobs import SessionJobs
from fleet.replay.rerun.viewer import VIEWER_HOST, NoViewer, Viewer, free_port
from schemas.bus import Failure
from schemas.suggestion import how_to_install
from schemas.words import RecorderVerb

MAX_EXPORTS: Final = 4
"""Maximum number of exports that are kept for downloads. Beyond it, the oldest one is deleted."""
FORMATS: Final = ("csv", "parquet")
_MAX_REQUEST_BYTES: Final = 8192


class SessionsApi:
    """The routes, and the processes that they started. place: the sessions folder.

    refusal: returns why a person (None: this computer) may not start and stop the recorder, or an empty text if they
    may.
    """

    def __init__(self, fleet: Fleet, place: Path, refusal: Callable[[PagePerson | None], str]) -> None:
        self._fleet = fleet
        self._place = place
        self._refusal = refusal
        self._jobs = SessionJobs()
        self._listing: asyncio.Task[tuple[int, str, str]] | None = None
        """The process that lists the sessions. All pages that ask while it runs share its result."""
        self._scratch: Path | None = None
        self._exports: dict[str, Path] = {}
        self._number = 0
        self._viewer: Viewer | None = None

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/sessions", self._list),
            Route("/sessions/{name}/download", self._download),
            Route("/sessions/{name}/verify", self._verify, methods=["POST"]),
            Route("/sessions/{name}/export/{format}", self._export, methods=["POST"]),
            Route("/sessions/{name}/view", self._view, methods=["POST"]),
            Route("/exports/{name}", self._download_export),
            Route("/recording/{verb}", self._record, methods=["POST"]),
        ]

    async def close(self) -> None:
        """End the processes, and remove the exported files."""
        self._jobs.kill()
        if self._viewer is not None:
            await asyncio.to_thread(self._viewer.close)
        if self._scratch is not None:
            await asyncio.to_thread(shutil.rmtree, self._scratch, ignore_errors=True)

    # ------------------------------------------------------------------ the recorder

    async def _record(self, request: Request) -> Response:
        verb = request.path_params["verb"]
        if verb not in tuple(RecorderVerb):
            return refuse(f"the recorder has no command {verb!r}", 404)
        person = request.scope.get(PERSON)
        by = self._fleet.sync.sender if person is None else person.name
        fields = {"sender": by}
        if verb in (RecorderVerb.START, RecorderVerb.STOP) and (words := self._refusal(person)):
            return refuse(words, 403)
        if verb == RecorderVerb.MARK:
            text = await read_body(request)
            if not text.strip():
                return refuse("A mark needs a text.")
            fields |= {"text": text, "by": by}
        answer = await self._fleet.call(ask_recorder, self._fleet.sync.bus, self._fleet.sync.name, verb, **fields)
        if answer is None:
            return refuse("No recorder is on the bus. `fleet record` starts one; `fleet up` records by itself.")
        if isinstance(answer, Failure):
            return refuse(answer.words)
        if verb == RecorderVerb.MARK and (why := why_unrecorded(answer)):
            return refuse(f"The mark is not in a file yet: {why}.")
        return JSONResponse(
            {
                "ok": True,
                "state": answer.state,
                "session": Path(answer.session).name,
                "messages": answer.messages,
                "bytes": answer.bytes,
                "free_bytes": answer.free_bytes,
                "words": answer.error or answer.warning,
            }
        )

    # ------------------------------------------------------------------ sessions

    async def _list(self, _: Request) -> Response:
        if not self._place.is_dir():
            return JSONResponse({"place": str(self._place), "sessions": []})
        if self._listing is None or self._listing.done():
            work = self._jobs.run("sessions", "list", str(self._place.absolute()), "--json")
            self._listing = asyncio.ensure_future(work)
        code, out, err = await asyncio.shield(self._listing)
        if code:
            return refuse(err)
        listed = [json.loads(line) for line in out.splitlines()]
        # Links are left out, because they lead out of the folder, so `session_path` would refuse them.
        links = await asyncio.to_thread(
            lambda: {path for path in self._place.absolute().iterdir() if path.is_symlink()}
        )
        found = [each for each in listed if Path(each["path"]) not in links]
        rows = [session_row(each) for each in reversed(found)]
        return JSONResponse({"place": str(self._place), "sessions": rows})

    async def _verify(self, request: Request) -> Response:
        path, wrong = await self._find(request)
        if path is None:
            return wrong
        code, out, err = await self._jobs.run_for(request, "sessions", "verify", str(path))
        return JSONResponse({"ok": code == 0, "words": out.strip() or err})

    async def _download(self, request: Request) -> Response:
        path, wrong = await self._find(request)
        if path is None:
            return wrong
        if path.is_file():
            return _stream(read_file(path), path.name)
        return _stream(zip_files(files_of(path), path.name), f"{path.name}.zip")

    async def _export(self, request: Request) -> Response:
        path, wrong = await self._find(request)
        if path is None:
            return wrong
        kind = request.path_params["format"]
        if kind not in FORMATS:
            return refuse(f"there is no format {kind!r}", 404)
        out = self._new_path(f"{path.stem if path.is_file() else path.name}-{kind}")
        code, said, err = await self._jobs.run_for(request, "sessions", "export", str(path), f"--{kind}", str(out))
        if code:
            return refuse(err)
        self._exports[out.name] = out
        while len(self._exports) > MAX_EXPORTS:
            shutil.rmtree(self._exports.pop(next(iter(self._exports))), ignore_errors=True)
        return JSONResponse({"ok": True, "words": said.partition(": ")[2].strip(), "url": f"/exports/{out.name}"})

    async def _download_export(self, request: Request) -> Response:
        out = self._exports.get(request.path_params["name"])
        if out is None:
            return refuse("this export was deleted. Export the session again.", 404)
        return _stream(zip_files(files_of(out), out.name), f"{out.name}.zip")

    async def _view(self, request: Request) -> Response:
        """Open the session in Rerun's viewer, at a port of its own.

        Inside a page of ours the viewer would delay STOP.
        """
        path, wrong = await self._find(request)
        if path is None:
            return wrong
        if PERSON in request.scope:
            return refuse("Rerun opens on the computer of the console only.")
        rrd = self._new_path("session").with_suffix(".rrd")
        code, _, err = await self._jobs.run_for(request, "replay", str(path), "--save", str(rrd))
        if code:
            return refuse(err)
        try:
            url = await asyncio.to_thread(self._open_viewer, rrd)
        except ModuleNotFoundError:
            return refuse(f"Rerun is not installed. Type: {how_to_install('view')}")
        except NoViewer as error:
            return refuse(str(error))
        return JSONResponse({"ok": True, "words": "", "url": url})

    def _open_viewer(self, rrd: Path) -> str:
        """Start the viewer in place of an earlier one. Return its address. Raises NoViewer."""
        if self._viewer is not None:
            self._viewer.close()
        port, page = free_port(), free_port()
        self._viewer = Viewer("--serve-web", "--port", str(port), "--web-viewer-port", str(page), str(rrd))
        self._viewer.wait_until_it_listens(page)
        return f"http://{VIEWER_HOST}:{page}/?url=rerun%2Bhttp://{VIEWER_HOST}:{port}/proxy"

    # ------------------------------------------------------------------ parts

    async def _find(self, request: Request) -> tuple[Path | None, Response]:
        """Return the session that a request names, or the refusal of the request."""
        try:
            return await asyncio.to_thread(session_path, self._place, request.path_params["name"]), Response()
        except (NotInFolder, OSError) as error:
            return None, refuse(str(error), 404)

    def _new_path(self, name: str) -> Path:
        if self._scratch is None:
            self._scratch = Path(tempfile.mkdtemp(prefix="fleet-console-"))
        self._number += 1
        return self._scratch / f"{name}-{self._number}"


_SHOWN: Final = ("state", "words", "length_s", "bytes", "messages", "lost", "cars", "kept")


def session_row(listed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a page shows of a session, from a line of `fleet sessions list --json`."""
    row = {"name": Path(listed["path"]).name, **{field: listed[field] for field in _SHOWN}}
    marks = [{"text": each.get("text"), "by": each.get("by"), **_moment(each.get("time"))} for each in listed["marks"]]
    return row | _moment(listed["started"]) | {"marks": marks}


def _moment(text: object) -> dict[str, int | None]:
    """Return a time (ms since the epoch), and this computer's offset from UTC at that time (s).

    If the text is no time, return None and 0.
    """
    try:
        at_s = datetime.fromisoformat(str(text)).timestamp()
        return {"at_ms": round(at_s * 1000), "zone_s": time.localtime(at_s).tm_gmtoff}
    except (ValueError, OverflowError, OSError):  # the recording has no time, or one that the clock cannot represent
        return {"at_ms": None, "zone_s": 0}


def _stream(data: Iterator[bytes], name: str) -> Response:
    """Answer with a file, whose parts are read on a thread."""
    headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(name, safe='')}"}  # RFC 6266
    return StreamingResponse(data, media_type="application/octet-stream", headers=headers)


def refuse(words: str, status: int = 200) -> Response:
    """Answer that a request was not carried out, with words for the user."""
    answer: dict[str, Any] = {"ok": False, "words": words}
    return JSONResponse(answer, status)


async def read_body(request: Request) -> str:
    """Return the text of a request. The part beyond the maximum is not read."""
    return (await read_start(request, _MAX_REQUEST_BYTES)).decode("utf-8", "replace")
