"""Splits the bytes of a car that sends lines. Pure, linear and bounded, for any bytes in any pieces."""

from typing import Final

MAX_LINE: Final = 1024
"""Maximum bytes of a line, without its end. Longer ones come in pieces of this length."""


class LineSplitter:
    """The lines of one connection, so that a new link never completes an old line.

    end: what ends one. Any other than a line end stays a part of it, such as the `}` of an object.
    """

    def __init__(self, max_line: int = MAX_LINE, *, end: bytes = b"\n") -> None:
        self._max_line = max_line
        self._end = end
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that end in these bytes, without CR and LF. Empty ones are left out."""
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
