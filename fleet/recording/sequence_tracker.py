"""Which publications of a key there are, by their publishers' numbers: what is missing, what comes twice. Pure.

Publishers count from 1, modulo 2^32. What was missed may be had again (`schemas.bus.Bus.recall`); it comes late then,
and perhaps along with what was not missed.
"""

from collections.abc import Hashable
from typing import Final

SENDERS: Final = 16
"""Whose numbers are remembered per key: every `fleet drive` is a sender of its own."""
HOLES: Final = 256
LATE: Final = 512
"""Publications had again before they came: those may still be under way. What a publisher holds, twice."""
_WRAP: Final = 1 << 32
_BACKWARDS: Final = 1 << 31


class SequenceTracker:
    """One key's. Who writes each message looks at `last` first: a number that follows the last one needs no more."""

    __slots__ = ("_first", "_holes", "_late", "_lost", "last")

    def __init__(self) -> None:
        self.last: dict[Hashable, int] = {}
        self._first: dict[Hashable, int] = {}
        self._holes: dict[Hashable, list[tuple[int, int]]] = {}
        self._late: dict[tuple[Hashable, int], int] = {}
        self._lost = 0

    @property
    def missing(self) -> int:
        """How many numbers are missing."""
        return self._lost + sum(high - low + 1 for holes in self._holes.values() for low, high in holes)

    @property
    def open(self) -> bool:
        """Whether some may still be had again."""
        return bool(self._holes)

    def live(self, sender: Hashable, number: int, published_ns: int) -> bool:
        """Take a number that does not follow its sender's last one; False if this publication was had already."""
        last = self.last.get(sender)
        if last is None:
            self._begin(sender, number)
            return True
        ahead = (number - last) % _WRAP
        if 0 < ahead < _BACKWARDS:
            self._skip(sender, last, ahead)
            self.last[sender] = number
            return True
        if self._late.get((sender, number)) == published_ns:
            del self._late[sender, number]
            return False
        if self._fill(sender, number):  # overtaken by what was had again
            return True
        self._forget(sender)  # a new stream of the same sender, not a gap of four thousand million
        self._begin(sender, number)
        return True

    def recalled(self, sender: Hashable, number: int, published_ns: int) -> bool:
        """Take a number that was asked for again; False if this publication was had already."""
        last = self.last.get(sender)
        if last is None:
            self._begin(sender, number)
            self._expect(sender, number, published_ns)
        elif 0 < (ahead := (number - last) % _WRAP) < _BACKWARDS:
            self._skip(sender, last, ahead)
            self.last[sender] = number
            self._expect(sender, number, published_ns)
        elif 0 < (before := (self._first[sender] - number) % _WRAP) < _BACKWARDS:
            self._skip(sender, number, before)
            self._first[sender] = number
        elif not self._fill(sender, number):
            return False
        return True

    def _expect(self, sender: Hashable, number: int, published_ns: int) -> None:
        """It may come yet. What newer ones overtook never does: publications of one publisher keep their order."""
        self._late[sender, number] = published_ns
        if len(self._late) > LATE:
            del self._late[next(iter(self._late))]

    def _begin(self, sender: Hashable, number: int) -> None:
        """Its first number says nothing about what was missed before it."""
        if len(self.last) >= SENDERS:
            oldest = next(iter(self.last))
            self._forget(oldest)
            del self.last[oldest]
        self.last[sender] = self._first[sender] = number

    def _skip(self, sender: Hashable, below: int, distance: int) -> None:
        """Note what lies between two numbers, both of which are there."""
        if distance == 1:
            return
        holes = self._holes.setdefault(sender, [])
        low, high = (below + 1) % _WRAP, (below + distance - 1) % _WRAP
        if low > high:  # over the wrap
            holes.append((low, _WRAP - 1))
            low = 0
        holes.append((low, high))
        while len(holes) > HOLES:
            low, high = holes.pop(0)
            self._lost += high - low + 1

    def _fill(self, sender: Hashable, number: int) -> bool:
        holes = self._holes.get(sender, [])
        for place, (low, high) in enumerate(holes):
            if low <= number <= high:
                holes[place : place + 1] = [
                    (one, other) for one, other in ((low, number - 1), (number + 1, high)) if one <= other
                ]
                if not holes:
                    del self._holes[sender]
                return True
        return False

    def _forget(self, sender: Hashable) -> None:
        self._lost += sum(high - low + 1 for low, high in self._holes.pop(sender, []))
        self._first.pop(sender, None)
