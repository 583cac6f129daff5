"""A file of raw bytes with their times: what `gateway monitor --raw` keeps, and looks at again. One JSON object a line.

The first line says what the file is; every other one has `t` (seconds since the start) and `rx` (bytes as Latin-1 text).
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

FORMAT: Final = "zenoh-car-fleet raw 1"


class BadCapture(ValueError):
    """A file that is no capture; its text names the file, the line and what is wrong."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes as they came; `at`: seconds since the start of the capture."""

    at: float
    data: bytes


class Writer:
    """Appends pieces; each is on its way to the disk at once, so that a killed monitor loses nothing."""

    def __init__(self, path: Path, link: str, started: str) -> None:
        self._file: IO[str] = path.open("x", encoding="utf-8")
        self._line({"format": FORMAT, "link": link, "started": started})

    def add(self, piece: Piece) -> None:
        """Keep one piece."""
        self._line({"t": round(piece.at, 6), "rx": piece.data.decode("latin-1")})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _line(self, content: dict[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()


def read(path: Path) -> Iterator[Piece]:
    """The pieces of a capture, in order; a last line that was cut is left out. Raises BadCapture and OSError."""
    with path.open(encoding="utf-8") as file:
        head = _parse(path, 1, file.readline())
        if head.get("format") != FORMAT:
            raise BadCapture(f"{path}: no capture of `gateway monitor --raw` (its first line is not {FORMAT!r})")
        for number, line in enumerate(file, start=2):
            if not line.endswith("\n"):
                return
            content = _parse(path, number, line)
            try:
                yield Piece(float(content["t"]), str(content["rx"]).encode("latin-1"))  # type: ignore[arg-type]  # what is no number raises
            except (KeyError, TypeError, ValueError):
                raise BadCapture(f"{path}:{number}: a line has t, a number, and rx, a text of bytes") from None


def _parse(path: Path, number: int, line: str) -> dict[str, object]:
    try:
        content = json.loads(line)
    except ValueError:
        raise BadCapture(
            f"{path}:{number}: not a line of JSON: is this a capture of `gateway monitor --raw`?"
        ) from None
    if not isinstance(content, dict):
        raise BadCapture(f"{path}:{number}: not a JSON object: is this a capture of `gateway monitor --raw`?")
    return content
