"""The numbers that publishers give their messages: which are missing, which came twice. Pure.

A message counts as its publisher numbered it: `seq` of the payload, from 1 at each start (`boot_id`). What has no such
field goes by the number that Zenoh carried, which begins again with each publisher.
"""

from dataclasses import dataclass, field
from typing import Final

MOST_GAPS: Final = 1000
"""So many gaps of one publisher are kept one by one; of more only the number is known."""


@dataclass(slots=True)
class Gap:
    """Messages that are not there: numbers `first` to `last`, which the recorder had between two times."""

    first: int
    last: int
    after_ns: int
    before_ns: int

    @property
    def count(self) -> int:
        """How many messages."""
        return self.last - self.first + 1


@dataclass(slots=True)
class Stream:
    """What was heard of one publisher on one key."""

    numbered: bool = True
    """Whether its number never begins again; if it may, a number that goes back is a new start."""
    first: int = 0
    last: int = 0
    count: int = 0
    twice: int = 0
    further: int = 0
    """Missing messages of gaps beyond MOST_GAPS."""
    gaps: list[Gap] = field(default_factory=list)
    _at_ns: int = 0

    @property
    def missing(self) -> int:
        """How many messages are not there."""
        return sum(gap.count for gap in self.gaps) + self.further

    def add(self, number: int, at_ns: int) -> bool:
        """Take the next message in the order of writing; whether it is the newest."""
        self.count += 1
        if self.count == 1:
            self.first = self.last = number
        elif number == self.last + 1:
            self.last = number
        elif number > self.last:
            self._gap(Gap(self.last + 1, number - 1, self._at_ns, at_ns))
            self.last = number
        elif self._fill(number):
            return False
        elif not self.numbered:
            self.last = number
        elif number < self.first:
            if number < self.first - 1:
                self._gap(Gap(number + 1, self.first - 1, at_ns, at_ns))
            self.first = number
            return False
        else:
            self.twice += 1
            return False
        self._at_ns = at_ns
        return True

    def _gap(self, gap: Gap) -> None:
        if len(self.gaps) < MOST_GAPS:
            self.gaps.append(gap)
        else:
            self.further += gap.count

    def _fill(self, number: int) -> bool:
        """Whether it was missing until now: it came late."""
        for at in range(len(self.gaps) - 1, -1, -1):
            gap = self.gaps[at]
            if gap.first <= number <= gap.last:
                parts = (
                    Gap(gap.first, number - 1, gap.after_ns, gap.before_ns),
                    Gap(number + 1, gap.last, gap.after_ns, gap.before_ns),
                )
                self.gaps[at : at + 1] = [part for part in parts if part.count > 0]
                return True
        return False
