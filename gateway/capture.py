"""Writes and reads capture files of `gateway monitor --raw`: raw bytes with their times, one JSON object per line.

The first line describes the file. Every other line has `t` (seconds since the start) and `rx` (bytes as Latin-1).
"""

import json
import math
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

from msgspec import Struct

FORMAT: Final = "zenoh-car-fleet raw 1"
# A link returns at most 1 MiB at once, and JSON needs at most 6 bytes for each byte.
MAX_LINE_BYTES: Final = 8 * 1024 * 1024


class BadCapture(ValueError):
    """A file that is not a capture. The message names the file, the fault, and the number of a bad line."""


class CapturedBytes(Struct, frozen=True):
    """Bytes as they arrived. `at` is in seconds since the start of the capture. The file rounds it to microseconds."""

    at: float
    data: bytes


class CaptureWriter:
    """Appends pieces to a new file and flushes each one, so that a killed monitor loses nothing.

    Raises OSError. If the file exists, this is a FileExistsError, because a capture is never overwritten.
    """

    def __init__(self, path: Path, link: str, started: str) -> None:
        self.path = path
        self._file: IO[str] = path.open("x", encoding="ascii", newline="\n")
        self._line({"format": FORMAT, "link": link, "started": started})

    def add(self, piece: CapturedBytes) -> None:
        """Write one piece."""
        self._line({"t": round(piece.at, 6), "rx": piece.data.decode("latin-1")})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def discard(self) -> None:
        """Close the file, which has no pieces, and remove it."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _line(self, content: dict[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()


def read(path: Path) -> Iterator[CapturedBytes]:
    """Yield the pieces of a capture in order, without a truncated last line. Raises BadCapture for any other file."""
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
        kind = "directory" if stat.S_ISDIR(mode) else "device"
        raise BadCapture(f"{path}: this is a {kind}, not a file of `gateway monitor --raw`")
    with path.open("rb") as file:
        first = file.readline(MAX_LINE_BYTES)
        if not first:
            raise BadCapture(f"{path}: the file is empty, not one of `gateway monitor --raw`")
        if _parse(path, 1, first).get("format") != FORMAT:
            raise BadCapture(f"{path}: not a file of `gateway monitor --raw`: its first line is not {FORMAT!r}")
        number, last = 1, 0.0
        while line := file.readline(MAX_LINE_BYTES):
            number += 1
            if not line.endswith(b"\n") and len(line) < MAX_LINE_BYTES:
                return
            piece = _piece(path, number, _parse(path, number, line))
            if piece.at < last:
                raise BadCapture(f"{path}:{number}: t is {piece.at:g}, less than the {last:g} before it")
            last = piece.at
            yield piece


def _piece(path: Path, number: int, content: dict[str, Any]) -> CapturedBytes:
    at, text = content.get("t"), content.get("rx")
    if isinstance(at, int | float) and not isinstance(at, bool) and at >= 0 and isinstance(text, str):
        try:
            piece = CapturedBytes(float(at), text.encode("latin-1"))
        except (OverflowError, UnicodeEncodeError):
            pass
        else:
            if math.isfinite(piece.at):
                return piece
    raise BadCapture(f"{path}:{number}: a line must have t, a number of at least 0, and rx, a text of bytes (Latin-1)")


def _parse(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        content = json.loads(line.decode())
    except (ValueError, RecursionError):  # ValueError: no UTF-8, no JSON, or a number with thousands of digits
        content = None
    if not isinstance(content, dict):
        raise BadCapture(f"{path}:{number}: not a JSON object: did `gateway monitor --raw` write this file?")
    return content
