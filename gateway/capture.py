"""A file of raw bytes with their times: what `gateway monitor --raw` keeps, and looks at again. One JSON object a line.

The first line says what the file is; every other one has `t` (seconds since the start) and `rx` (bytes as Latin-1).
"""

import json
import math
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

FORMAT: Final = "zenoh-car-fleet raw 1"
LINE_LIMIT: Final = 8 * 1024 * 1024
"""A link hands out at most 1 MiB at once, and a byte takes at most 6 of JSON; no capture has a longer line."""


class BadCapture(ValueError):
    """A file that is no capture; its text names the file, the line and what is wrong."""


@dataclass(frozen=True, slots=True)
class CapturedBytes:
    """Bytes as they came; `at`: seconds since the start of the capture, kept to the microsecond."""

    at: float
    data: bytes


class CaptureWriter:
    """Appends pieces to a new file; each is handed to the system at once, so that a killed monitor loses nothing.

    Raises OSError, FileExistsError among them: a capture is never written over.
    """

    def __init__(self, path: Path, link: str, started: str) -> None:
        self.path = path
        self._file: IO[str] = path.open("x", encoding="ascii", newline="\n")
        self._line({"format": FORMAT, "link": link, "started": started})

    def add(self, piece: CapturedBytes) -> None:
        """Keep one piece."""
        self._line({"t": round(piece.at, 6), "rx": piece.data.decode("latin-1")})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def discard(self) -> None:
        """Close the file and remove it: nothing will come."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _line(self, content: dict[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()


def read(path: Path) -> Iterator[CapturedBytes]:
    """The pieces of a capture, in order; a last line that was cut is left out. Raises BadCapture and OSError."""
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
        kind = "directory" if stat.S_ISDIR(mode) else "device"
        raise BadCapture(f"{path}: this is a {kind}, not a file that `gateway monitor --raw` kept")
    with path.open("rb") as file:
        first = file.readline(LINE_LIMIT)
        if not first:
            raise BadCapture(f"{path}: the file is empty, not one that `gateway monitor --raw` kept")
        if _parse(path, 1, first).get("format") != FORMAT:
            raise BadCapture(f"{path}: not a file that `gateway monitor --raw` kept: its first line is not {FORMAT!r}")
        number, last = 1, 0.0
        while line := file.readline(LINE_LIMIT):
            number += 1
            if not line.endswith(b"\n") and len(line) < LINE_LIMIT:
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
    raise BadCapture(f"{path}:{number}: a line has t, a number from 0 on, and rx, a text of bytes (Latin-1)")


def _parse(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        content = json.loads(line.decode())
    except (ValueError, RecursionError):  # ValueError: no UTF-8, no JSON, or a number with thousands of digits
        content = None
    if not isinstance(content, dict):
        raise BadCapture(f"{path}:{number}: not a JSON object: did `gateway monitor --raw` keep this file?")
    return content
