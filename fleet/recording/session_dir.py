"""A session's directory: its name, what lies in it, and `session.json`, which describes it. No MCAP and no bus here.

`sessions/20260314T151617Z-fleet/` holds `session.json`, the segments `0001.mcap`, `0002.mcap`, ..., copies of the fleet
file and the plan if there are any, and `index.json`: by segment what is in it, for who is in a hurry. A cache only.
While it is recorded there is also `session.json.spare`, into which the description is written when the disk is full.
"""

import contextlib
import errno
import json
import platform
import shutil
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from io import FileIO
from pathlib import Path
from typing import Any, Final, Self

DESCRIPTION: Final = "session.json"
INDEX: Final = "index.json"
SPARE: Final = "session.json.spare"
SPARE_BYTES: Final = 256 * 1024
"""Room for a hundred cars' drops by key; a file system that never writes in place (btrfs) may refuse it in need."""
FLEET_FILE: Final = "fleet.yaml"
PLAN: Final = "plan.yaml"
SEGMENTS: Final = "[0-9][0-9][0-9][0-9].mcap"
FORMAT: Final = 1
"""Raised when a reader of the old layout could misread a session."""

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT} if sys.platform != "win32" else {errno.ENOSPC})
_PACKAGES: Final = ("zenoh-car-fleet", "eclipse-zenoh", "mcap", "protobuf")


def versions() -> dict[str, str]:
    """What wrote a session: our version, Python's and those of the packages that shape it."""
    return {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}


@dataclass(slots=True)
class SessionInfo:
    """What `session.json` says."""

    fleet: str
    started: str
    """ISO 8601, UTC."""
    host: str
    versions: Mapping[str, str]
    ended: str | None = None
    closed: bool = False
    """Whether the recorder ended the session itself; False also while it is still recording."""
    messages: int = 0
    drops: Mapping[str, int] = field(default_factory=dict)
    missed: Mapping[str, int] = field(default_factory=dict)
    error: str = ""
    """What went wrong, also if the recording went on after it."""
    recovered: Mapping[str, int] = field(default_factory=dict)
    """By key: missed at first, and had again from who published it. Those lie in the file later than their numbers."""
    continues: str = ""
    """The session that this one goes on with: its recorder was killed, and what it had not written yet is here."""
    format: int = FORMAT
    marks: Sequence[Mapping[str, Any]] = ()
    """What people said while it was recorded: `time` (ISO 8601), `text`, `by`."""
    kept: bool = False
    """Whether it is spared when room is made for others."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """Of what it was made, by what (`recover`, `cut`), and what could not be saved; empty: it was recorded."""

    @classmethod
    def read(cls, directory: Path) -> Self | None:
        """The description in a directory; None if there is none that can be read. Unknown fields are left out."""
        path = directory / DESCRIPTION
        try:
            values: Any = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
            if not _sound(values):
                return None
            return cls(**{name: values[name] for name in cls.__slots__ if name in values})
        except (OSError, ValueError, TypeError, AttributeError):
            return None

    def write(self, directory: Path) -> None:
        """Replace the description in a directory, whole or not at all; raises OSError.

        On a full disk it takes the room that was reserved, if it was.
        """
        values = {name: getattr(self, name) for name in self.__slots__}
        try:
            replace(directory / DESCRIPTION, values, indent=2)
        except OSError as error:
            spare = directory / SPARE
            if not is_full(error) or not spare.is_file():
                raise
            with spare.open("r+b", buffering=0) as file:
                file.truncate(_write_all(file, (json.dumps(values) + "\n").encode()))
            spare.replace(directory / DESCRIPTION)
            with contextlib.suppress(OSError):  # of what the old one took, and the rest of the spare one
                reserve(directory)


def is_full(error: OSError) -> bool:
    """Whether there was no room, on the disk or in the user's share of it."""
    return error.errno in _FULL


def reserve(directory: Path) -> None:
    """Keep room for one more description; raises OSError, and keeps what there was then."""
    with (directory / SPARE).open("ab", buffering=0) as file:
        _write_all(file, bytes(max(0, SPARE_BYTES - file.tell())))


def release(directory: Path) -> None:
    """Keep no more room; raises OSError."""
    (directory / SPARE).unlink(missing_ok=True)


def _write_all(file: FileIO, data: bytes) -> int:
    """Write without a buffer, which would be written again, and fail again, when the file is closed."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]
    return len(data)


def replace(path: Path, values: object, indent: int | None = None) -> None:
    """Write JSON to a file, whole or not at all; raises OSError."""
    new = path.with_name(path.name + ".new")
    try:
        new.write_text(json.dumps(values, indent=indent) + "\n", encoding="utf-8")
        new.replace(path)
    except OSError:
        with contextlib.suppress(OSError):  # on a full disk an empty file is all that is left of it
            new.unlink()
        raise


_COUNTS: Final = ("drops", "missed", "recovered")
_TYPES: Final[Mapping[str, type]] = {
    **dict.fromkeys(("fleet", "started", "host", "error", "continues"), str),
    **dict.fromkeys(("format", "messages"), int),
    **dict.fromkeys(("versions", "origin", *_COUNTS), dict),
    "marks": list,
}


def _sound(values: Mapping[str, Any]) -> bool:
    """Whether what was read is of the types that it should be: whoever edits the file by hand ends nobody's reading."""
    return (
        all(isinstance(values[name], kind) for name, kind in _TYPES.items() if name in values)
        and all(isinstance(count, int) for name in _COUNTS for count in values.get(name, {}).values())
        and all(isinstance(mark, dict) for mark in values.get("marks", []))
        and isinstance(values.get("ended"), str | None)
    )


def iso(now: datetime) -> str:
    """A time as `session.json` has it."""
    return now.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def plan(root: Path, fleet: str, now: datetime) -> tuple[Path, SessionInfo]:
    """Where a new session is to be, and its description; nothing is made."""
    stem = f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{fleet}"
    return _unused(root / stem), SessionInfo(fleet, iso(now), socket.gethostname(), versions())


def create(directory: Path, description: SessionInfo) -> Path:
    """Make a session's directory, under another name if that one is taken by now; raises OSError, and leaves none."""
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
    """The path of a segment, counted from 1."""
    return directory / f"{number:04d}.mcap"
