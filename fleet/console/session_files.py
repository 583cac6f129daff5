"""The sessions folder for the pages: finds the session of a name, and yields its files as a stream of bytes."""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from fleet.recording import session_dir

_READ_BYTES: Final = 256 * 1024


class NotInFolder(Exception):
    """There is no session with this name in the folder."""


def session_path(place: Path, name: str) -> Path:
    """Return the path of the session of this name. Raises NotInFolder.

    The name must be that of an entry of the folder: no other path can be formed with it. A link is refused, because it
    may lead elsewhere.
    """
    entries = {each.name: each for each in place.iterdir()} if place.is_dir() else {}
    path = entries.get(name)
    if path is None or name.startswith(".") or path.is_symlink() or not session_dir.is_session(path):
        raise NotInFolder(f"There is no session {name!r}.")
    return path


def files_of(path: Path) -> list[Path]:
    """Return the files of a session, without links and the recorder's spare file, which only reserves disk space."""
    if path.is_file():
        return [path]
    names = sorted(each for each in path.iterdir() if each.is_file() and not each.is_symlink())
    return [each for each in names if each.name != session_dir.SPARE_FILE]


class _Pipe:
    """A buffer of written bytes for a stream.

    It cannot seek, so the zip module never needs the whole archive in memory.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def write(self, data: bytes, /) -> int:
        """Keep the data."""
        self._parts.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Do nothing."""

    def take(self) -> bytes:
        """Return what was written, and empty the buffer."""
        parts, self._parts = self._parts, []
        return b"".join(parts)


def read_file(path: Path) -> Iterator[bytes]:
    """Yield a file in parts, up to its present end: it may be growing."""
    left = path.stat().st_size
    with path.open("rb") as file:
        while left > 0 and (data := file.read(min(_READ_BYTES, left))):
            left -= len(data)
            yield data


def zip_files(files: list[Path], folder: str) -> Iterator[bytes]:
    """Yield a zip archive of these files in parts, uncompressed: recordings are compressed already."""
    pipe = _Pipe()
    sink: Any = pipe
    with zipfile.ZipFile(sink, "w", allowZip64=True) as archive:
        for path in files:
            with archive.open(f"{folder}/{path.name}", "w", force_zip64=True) as entry:
                for data in read_file(path):
                    entry.write(data)
                    yield pipe.take()
            yield pipe.take()
    yield pipe.take()
