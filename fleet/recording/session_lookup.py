"""Finds the session that a name means: a path, a name in the directory of sessions, `latest`, or `latest~1`.

The rule is the same for the command line and Python. `latest` is the session whose recording began last. Sessions that
a tool made from others (cut, merge, recover) do not count.
"""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fleet.recording.session_dir import SessionInfo, is_session

DEFAULT_SESSIONS: Final = Path("sessions")
_FLEET_YAML: Final = Path("fleet.yaml")
_LATEST: Final = re.compile(r"latest(?:~(\d{1,6}))?", re.ASCII)
_STAMP: Final = re.compile(r"\d{8}T\d{6}Z", re.ASCII)


class NoLatest(LookupError):
    """There are fewer sessions than the name asks for. The text says how many there are, and where."""


def sessions_place() -> Path:
    """Return the directory of sessions: the one that the fleet file here names, or `sessions`.

    `fleet up` records there, and with `--sim` in `sessions`. If both exist, return the one that was changed last.
    """
    return _places()[0]


def _places() -> list[Path]:
    """Return the directories in which `fleet up` here may have recorded, the likeliest first."""
    named: Path | None = None
    with suppress(OSError, ValueError):  # BadFile is a ValueError
        if "record" in _FLEET_YAML.read_text(encoding="utf-8"):  # otherwise, do not load the parser, which takes long
            from fleet.fleetfile.fleet_file import read_fleet

            named = read_fleet(_FLEET_YAML, unbound=True).recordings
    places = [DEFAULT_SESSIONS] if named is None else [named, DEFAULT_SESSIONS]
    return sorted((each for each in places if each.is_dir()), key=_changed, reverse=True) or places


def _changed(place: Path) -> float:
    try:
        return place.stat().st_mtime
    except OSError:  # removed meanwhile
        return 0.0


def sessions_in(place: Path) -> Iterator[Path]:
    """Yield all sessions of a directory."""
    yield from (each for each in (place.iterdir() if place.is_dir() else ()) if is_session(each))


def newest_first(place: Path) -> list[Path]:
    """Return the recorded sessions of a directory, newest first."""
    found = [(info, each) for each in sessions_in(place) if not ((info := SessionInfo.read(each)) and info.origin)]
    return [path for _, path in sorted(found, key=lambda each: _begun(*each), reverse=True)]


def _begun(info: SessionInfo | None, path: Path) -> tuple[str, float]:
    """Return the start of a session: from its description, else from its name, else the time of its last change."""
    changed = path.stat().st_mtime
    if info is not None and info.started:
        return re.sub(r"[-:]|\.\d+", "", info.started), changed
    stamp = _STAMP.match(path.name)
    return stamp[0] if stamp else f"{datetime.fromtimestamp(changed, UTC):%Y%m%dT%H%M%SZ}", changed


def find_session(session: str | os.PathLike[str], place: Path | None = None) -> Path:
    """Return the path that a name means, even if nothing is there. Raises NoLatest.

    `place` is the directory of sessions. Without it, a name is searched wherever `fleet up` here may have recorded.
    """
    path = Path(session)
    # `os.path.exists` is False for a path that is too long or may not be read. Opening it then gives the reason.
    if os.path.exists(path):  # noqa: PTH110
        return path
    places = [place] if place is not None else _places()
    match = _LATEST.fullmatch(str(session))
    if match is None:
        there = (each / path for each in places if os.path.exists(each / path))  # noqa: PTH110 - as above
        return next(there, path)
    place = places[0]
    found = newest_first(place)
    if not found and any(sessions_in(place)):
        raise NoLatest(f"All sessions in {place} are made of others: name one of them (`fleet sessions` lists them).")
    if not found:
        raise NoLatest(f"No recordings here yet (in {place}). `fleet up` records in the directory where it is typed.")
    back = int(match[1] or 0)
    if back >= len(found):
        count = "is only 1 recorded session" if len(found) == 1 else f"are only {len(found)} recorded sessions"
        raise NoLatest(f"{session}: there {count} in {place}.")
    return found[back]
