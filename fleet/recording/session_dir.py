"""Layout of a session directory: its name, its files and `session.json`. Knows neither MCAP nor the bus.

`sessions/20260314T151617Z-fleet/` contains:
- `session.json`, the description;
- the segments `0001.mcap`, `0002.mcap`, ...;
- copies of the fleet file and the plan, if any;
- `index.json`, a cache with the counts of each segment;
- during recording `session.json.spare`, reserved space for the description in case the disk gets full.

`sessions/removed.json` lists the sessions that a quota has removed.
"""

import contextlib
import errno
import json
import platform
import shutil
import socket
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatch
from io import FileIO
from pathlib import Path
from typing import Any, Final, Self

from msgspec import Struct, field
from msgspec.structs import asdict

from fleet.recording.time_spec import format_utc, iso
from schemas.atomic_file import write_atomically

SESSION_FILE: Final = "session.json"
INDEX_FILE: Final = "index.json"
SPARE_FILE: Final = "session.json.spare"
REMOVED_FILE: Final = "removed.json"
TABLES_PREFIX: Final = ".tables-"
"""Prefix of directories with tables for SQL questions (table_cache.py)."""
SPARE_BYTES: Final = 256 * 1024
"""Reserved space: enough to list the drops of 100 cars by key. Copy-on-write file systems (btrfs) may not honor it."""
FLEET_FILE: Final = "fleet.yaml"
PLAN_FILE: Final = "plan.yaml"
SEGMENTS: Final = "[0-9][0-9][0-9][0-9].mcap"
MAX_MARK_CHARACTERS: Final = 1000
"""Maximum length of the text of a mark, and of its author."""
FORMAT_VERSION: Final = 1
"""Version of the layout. Increase it if older readers could misread a session."""

_FULL_ERRORS: Final = frozenset({errno.ENOSPC, errno.EDQUOT} if sys.platform != "win32" else {errno.ENOSPC})
_VERSIONED_PACKAGES: Final = ("zenoh-car-fleet", "eclipse-zenoh", "mcap", "protobuf")


def versions() -> dict[str, str]:
    """Return the versions of Python, our package and the packages that affect the format."""
    from importlib.metadata import version  # here, because the import would slow down all commands

    return {"python": platform.python_version(), **{name: version(name) for name in _VERSIONED_PACKAGES}}


class SessionInfo(Struct):
    """Content of `session.json`."""

    fleet: str
    started: str
    """ISO 8601, UTC."""
    host: str
    versions: Mapping[str, str]
    ended: str | None = None
    closed: bool = False
    """True if the recorder closed the session. False while it records, and after a crash."""
    messages: int = 0
    drops: Mapping[str, int] = field(default_factory=dict)
    missed: Mapping[str, int] = field(default_factory=dict)
    error: str = ""
    """Last error, even if the recording continued."""
    recovered: Mapping[str, int] = field(default_factory=dict)
    """Backfilled messages by key. They come later in the file than their sequence numbers suggest."""
    continues: str = ""
    """Name of the interrupted session that this one continues. Messages that it could not write are backfilled here."""
    format: int = FORMAT_VERSION
    marks: Sequence[Mapping[str, Any]] = ()
    """Marks: `time` (ISO 8601), `text`, `by`. Those that were set after the recording also have `added`."""
    kept: bool = False
    """True if the quota spares the session. The name is part of the file format."""
    stops: int | None = None
    """Number of recorded commands that stop cars. None if nobody has counted them."""
    pins: Sequence[Mapping[str, Any]] = ()
    """Times that the quota removes last, as `Pin.to_dict` writes them. The times around marks are not listed here."""
    gone: Sequence[Mapping[str, Any]] = ()
    """Segments that the quota has removed: `file`, `from`, `to` (ISO 8601), `messages` (null if unknown), `pinned`."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """Source session, tool (`recover`, `cut`, `merge`) and losses. Empty if the session was recorded."""

    @classmethod
    def read(cls, directory: Path) -> Self | None:
        """Return the description in a directory, or None if it is missing or invalid. Ignore unknown fields."""
        path = directory / SESSION_FILE
        try:
            values: Any = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
            if not _is_valid(values):
                return None
            return cls(**{name: values[name] for name in cls.__struct_fields__ if name in values})
        except (OSError, ValueError, TypeError, AttributeError, RecursionError):
            return None

    def write(self, directory: Path) -> None:
        """Replace the description in a directory atomically. Raises OSError if that fails.

        If the disk is full, use the reserved space.
        """
        values = asdict(self)
        try:
            replace(directory / SESSION_FILE, values, indent=2)
        except OSError as error:
            spare = directory / SPARE_FILE
            if not is_full(error) or not spare.is_file():
                raise
            with spare.open("r+b", buffering=0) as file:
                file.truncate(write_all(file, (json.dumps(values) + "\n").encode()))
            spare.replace(directory / SESSION_FILE)
            with contextlib.suppress(OSError):  # use the space that the old description has freed
                reserve(directory)


def gone_of(info: SessionInfo) -> list[Mapping[str, Any]]:
    """Return the segments that the quota has removed from a session. Leave out invalid entries."""
    wanted = {"file": str, "from": str, "to": str}
    return [each for each in info.gone if all(isinstance(each.get(name), kind) for name, kind in wanted.items())]


def gone_messages(info: SessionInfo) -> int | None:
    """Return how many messages the quota has removed, or None if those of one file were not counted."""
    counts = [each.get("messages") for each in info.gone]
    known = [count for count in counts if isinstance(count, int)]
    return sum(known) if len(known) == len(counts) else None


def add_gone(directory: Path, gone: Sequence[Mapping[str, Any]]) -> None:
    """List in `session.json` the segments that the quota removes. Raises OSError, also if the file cannot be read."""
    path = directory / SESSION_FILE
    values = read_json(path)
    if not values or not _is_valid(values):
        raise OSError(errno.EIO, "is not a description", str(path))
    listed = {each.get("file"): each for each in values.get("gone", [])}
    listed |= {each["file"]: each for each in gone}
    replace(path, {**values, "gone": [listed[name] for name in sorted(listed, key=str)]}, indent=2)


def removed_sessions(place: Path) -> list[dict[str, Any]]:
    """Return the sessions that a quota has removed from a directory, the newest last."""
    listed = read_json(place / REMOVED_FILE).get("sessions")
    return [each for each in listed if isinstance(each, dict)] if isinstance(listed, list) else []


def indexed_segments(directory: Path) -> list[dict[str, Any]]:
    """Return the entries of `index.json`, or none if there is no such file."""
    indexed = read_json(directory / INDEX_FILE).get("segments") if directory.is_dir() else None
    named = [one for one in indexed if isinstance(one, dict)] if isinstance(indexed, list) else []
    return [one for one in named if isinstance(one.get("file"), str) and fnmatch(one["file"], SEGMENTS)]


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file. Return an empty one if the file is missing, unreadable, or no JSON object."""
    try:
        values = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


class NoMark(Exception):
    """A session cannot be marked. The message gives the reason."""


def add_mark(directory: Path, at_ns: int, text: str, by: str) -> None:
    """Add a mark to `session.json` of a closed session, and exempt it from the quota. Raises NoMark, OSError.

    at_ns: the marked moment, ns since the epoch. A mark that is already there is not added again. The mark has the key
    `added`, the time at which it was made, because it is not among the recorded messages: `@recorder/mark` has only
    marks that were set during recording.
    """
    if not directory.is_dir():
        raise NoMark(f"it is one file without {SESSION_FILE}, where marks of closed sessions are stored")
    path = directory / SESSION_FILE
    if not path.exists():
        raise NoMark(
            f"it has no {SESSION_FILE}, where marks of closed sessions are stored: "
            "`fleet sessions recover` makes a copy with one"
        )
    info = SessionInfo.read(directory)
    if info is None or info.format > FORMAT_VERSION:
        raise NoMark(f"its {SESSION_FILE} cannot be read by this version")
    if not info.closed:
        # A recorder would write its own description over this one.
        raise NoMark(
            "the recorder has not closed it: `fleet mark` marks now, `fleet sessions recover` makes a closed copy"
        )
    mark = {"time": iso(at_ns), "text": text, "by": by}
    if any({name: each.get(name) for name in mark} == mark for each in info.marks):
        return
    # Keep fields of a newer version.
    values = json.loads(path.read_text(encoding="utf-8"))
    values["marks"] = [*info.marks, {**mark, "added": format_utc(datetime.now(UTC))}]
    replace(path, {**values, "kept": True}, indent=2)


def is_full(error: OSError) -> bool:
    """Return True if the disk or the user's quota is full."""
    return error.errno in _FULL_ERRORS


def reserve(directory: Path) -> None:
    """Reserve space for one more description. If that raises OSError, the space reserved so far stays reserved."""
    with (directory / SPARE_FILE).open("ab", buffering=0) as file:
        write_all(file, bytes(max(0, SPARE_BYTES - file.tell())))


def release(directory: Path) -> None:
    """Free the reserved space. Raises OSError if that fails."""
    (directory / SPARE_FILE).unlink(missing_ok=True)


def write_all(file: FileIO, data: bytes) -> int:
    """Write all data without a buffer, and return its size. A buffer would fail again when the file is closed."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]
    return len(data)


def replace(path: Path, values: object, indent: int | None = None) -> None:
    """Write JSON to a file atomically. Raises OSError if that fails."""
    write_atomically(path, f"{json.dumps(values, indent=indent)}\n".encode())


_LISTS: Final = ("marks", "pins", "gone")
_TEXTS: Final = {"marks": ("time", "text", "by"), "pins": ("from", "to", "cause", "words")}
_COUNTS: Final = ("drops", "missed", "recovered")
_FIELD_TYPES: Final[Mapping[str, type]] = {
    **dict.fromkeys(("fleet", "started", "host", "error", "continues"), str),
    **dict.fromkeys(("format", "messages"), int),
    **dict.fromkeys(("versions", "origin", *_COUNTS), dict),
    **dict.fromkeys(_LISTS, list),
}


def _is_valid(values: Mapping[str, Any]) -> bool:
    """Return True if all values have the right types. A wrong edit by hand must not make a session unreadable."""
    return (
        all(isinstance(values[name], kind) for name, kind in _FIELD_TYPES.items() if name in values)
        and all(isinstance(count, int) for name in _COUNTS for count in values.get(name, {}).values())
        and all(isinstance(each, dict) for name in _LISTS for each in values.get(name, []))
        and all(
            isinstance(each.get(text), str | None)
            for name, texts in _TEXTS.items()
            for each in values.get(name, [])
            for text in texts
        )
        and isinstance(values.get("ended"), str | None)
        and isinstance(values.get("stops"), int | None)
    )


def plan(root: Path, fleet: str, now: datetime) -> tuple[Path, SessionInfo]:
    """Return the path and description of a new session without creating it."""
    stem = f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{fleet}"
    return _unused(root / stem), SessionInfo(fleet, format_utc(now), socket.gethostname(), versions())


def is_session(path: Path) -> bool:
    """Return True for the directory of a session and for a single MCAP file."""
    if not path.is_dir():
        return path.suffix == ".mcap" and path.is_file()
    described = (path / SESSION_FILE).exists() or next(path.glob(SEGMENTS), None) is not None
    return described and not path.name.startswith(".")


def create(directory: Path, description: SessionInfo) -> Path:
    """Create the directory of a session, under another name if its name is taken. An OSError leaves no directory."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    while True:
        try:
            directory.mkdir()
            break
        except FileExistsError:
            directory = _unused(directory)
    try:
        reserve(directory)
        description.write(directory)
    except OSError:
        shutil.rmtree(directory, ignore_errors=True)
        raise
    return directory


def _unused(directory: Path) -> Path:
    found, number = directory, 2
    while found.exists():
        found, number = directory.with_name(f"{directory.name}-{number}"), number + 1
    return found


def segment(directory: Path, number: int) -> Path:
    """Return the path of a segment, counted from 1."""
    return directory / f"{number:04d}.mcap"
