"""A session's directory: its name, what lies in it, and `session.json`, which describes it. No MCAP and no bus here.

`sessions/20260314T151617Z-fleet/` holds `session.json`, the segments `0001.mcap`, `0002.mcap`, ..., copies of the fleet
file and the plan if there are any, and `index.json`: by segment what is in it, for who is in a hurry. A cache only.
"""

import contextlib
import json
import platform
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Self

DESCRIPTION: Final = "session.json"
INDEX: Final = "index.json"
FLEET_FILE: Final = "fleet.yaml"
PLAN: Final = "plan.yaml"
SEGMENTS: Final = "[0-9][0-9][0-9][0-9].mcap"
FORMAT: Final = 1
"""Raised when a reader of the old layout could misread a session."""

_PACKAGES: Final = ("zenoh-car-fleet", "eclipse-zenoh", "mcap", "protobuf")


def versions() -> dict[str, str]:
    """What wrote a session: our version, Python's and those of the packages that shape it."""
    return {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}


@dataclass(slots=True)
class Description:
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
        """Replace the description in a directory, whole or not at all; raises OSError."""
        replace(directory / DESCRIPTION, {name: getattr(self, name) for name in self.__slots__}, indent=2)


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


def create(root: Path, fleet: str, now: datetime) -> tuple[Path, Description]:
    """Make the directory of a new session below `root`, described as not closed; raises OSError."""
    stem = f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{fleet}"
    directory = root / stem
    root.mkdir(parents=True, exist_ok=True)
    number = 2
    while True:
        try:
            directory.mkdir()
            break
        except FileExistsError:
            directory = root / f"{stem}-{number}"
            number += 1
    description = Description(fleet, iso(now), socket.gethostname(), versions())
    description.write(directory)
    return directory, description


def segment(directory: Path, number: int) -> Path:
    """The path of a segment, counted from 1."""
    return directory / f"{number:04d}.mcap"
