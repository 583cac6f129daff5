"""Splits the bytes of a car that sends lines. Pure. Work and memory are bounded, whatever bytes arrive."""

from typing import Final

MAX_LINE: Final = 1024
"""Maximum bytes of a line, without its end. A longer line is returned in pieces of this length."""


class LineSplitter:
    """Splits the lines of one connection. A new link needs a new splitter, because it must not complete an old line.

    `end` is the bytes that end a line. If it is not a line end but, for example, the `}` of an object, it stays a part
    of the line.
    """

    def __init__(self, max_line: int = MAX_LINE, *, end: bytes = b"\n") -> None:
        self._max_line = max_line
        self._end = end
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that end in these bytes, without CR and LF. Leave out empty lines."""
        found: list[bytes] = []
        *whole, rest = data.split(self._end)
        for piece in whole:
            self._add(piece + self._end.strip(b"\n"), found)
            found.append(bytes(self._rest))
            self._rest.clear()
        self._add(rest, found)
        return [line for each in found if (line := each.strip(b"\r\n") if self._end != b"\n" else each.rstrip(b"\r"))]

    def _add(self, piece: bytes, found: list[bytes]) -> None:
        self._rest += piece
        while len(self._rest) > self._max_line:
            found.append(bytes(self._rest[: self._max_line]))
            del self._rest[: self._max_line]

    def take_rest(self) -> bytes:
        """Return the unfinished line, and forget it."""
        rest = bytes(self._rest)
        self._rest.clear()
        return rest
