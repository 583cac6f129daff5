"""Tracks the sequence numbers of publishers: gaps, duplicates, late messages. Pure.

The recorder uses `SequenceTracker` to request backfills, `sessions verify` uses `PublisherSequence` to report losses.
"""

from collections.abc import Hashable
from typing import Final

from msgspec import Struct, field

MAX_TRACKED_SOURCES: Final = 16
"""Maximum number of senders to remember per key. Each `fleet drive` is a new sender."""
MAX_FORGOTTEN_SOURCES: Final = 256
"""Maximum number of further senders of which only the name is remembered, so that they are not taken for new ones."""
MAX_OPEN_GAPS: Final = 256
"""Maximum number of gaps of one sender that a backfill may close. Older gaps are only counted."""
MAX_LISTED_GAPS: Final = 1000
"""Maximum number of gaps of one publisher to list. Later gaps are only counted."""
MAX_EARLY_BACKFILLS: Final = 512
"""Maximum number of remembered backfilled messages whose originals may still arrive: about twice a publisher's
cache."""
_MODULO: Final = 1 << 32
_BACKWARD: Final = 1 << 31


class Gap(Struct):
    """Missing messages `first` to `last`. `PublisherSequence` also sets the receive times before and after the gap."""

    first: int
    last: int
    after_ns: int = 0
    before_ns: int = 0

    @property
    def count(self) -> int:
        """Return the number of missing messages."""
        return self.last - self.first + 1

    def __contains__(self, number: int) -> bool:
        return self.first <= number <= self.last


def _fill(gaps: list[Gap], number: int) -> bool:
    """Remove a number from the gap that contains it. Return False if no gap does."""
    for place in range(len(gaps) - 1, -1, -1):
        gap = gaps[place]
        if number in gap:
            parts = (
                Gap(gap.first, number - 1, gap.after_ns, gap.before_ns),
                Gap(number + 1, gap.last, gap.after_ns, gap.before_ns),
            )
            gaps[place : place + 1] = [part for part in parts if part.count > 0]
            return True
    return False


class TrackedSender(Struct):
    """The received messages of one sender of a key."""

    last: int
    """The newest number."""
    first: int
    heard_ns: int = 0
    """When the newest message was received, ns. If only answers came, about when the first would have been live.
    0 if none did."""
    gaps: list[Gap] = field(default_factory=list)
    """Gaps that a backfill may still close."""
    earlier_gaps: list[Gap] = field(default_factory=list)
    """Gaps of the sessions before this one. If their messages come, they go to this session."""

    def fill(self, number: int) -> bool:
        """Remove a number from the gap that contains it. Return False if no gap does."""
        return _fill(self.gaps, number) or _fill(self.earlier_gaps, number)


class SequenceTracker:
    """Tracks the live and backfilled messages of one key. Numbers count from 1, modulo 2^32.

    Call `add_live` only if the number does not follow `last` of its sender. For a consecutive number, the caller sets
    `last` itself. The caller also sets `heard_ns`.
    """

    __slots__ = ("_early", "_forgotten", "_lost", "senders")

    def __init__(self) -> None:
        self.senders: dict[Hashable, TrackedSender] = {}
        self._early: dict[tuple[Hashable, int], int] = {}
        self._forgotten: dict[Hashable, None] = {}
        self._lost = 0

    def following(self) -> "SequenceTracker":
        """Return the tracker of the session that follows this one without a pause.

        It notices a gap between the two sessions, and takes no message that this one has. The gaps of this one are
        missing only here, but if their messages come, the next session takes them.
        """
        tracker = SequenceTracker()
        tracker._early, tracker._forgotten = self._early, self._forgotten
        for name, sender in self.senders.items():
            earlier = [*sender.earlier_gaps, *sender.gaps][-MAX_OPEN_GAPS:]
            tracker.senders[name] = TrackedSender(sender.last, sender.first, sender.heard_ns, earlier_gaps=earlier)
        return tracker

    @property
    def missing(self) -> int:
        """Return the number of missing messages."""
        return self._lost + sum(gap.count for sender in self.senders.values() for gap in sender.gaps)

    def has_forgotten(self, sender: Hashable) -> bool:
        """Return True if this sender was heard before, although its numbers had to be forgotten at some time."""
        return sender in self._forgotten

    def add_live(self, sender: Hashable, number: int, content: int) -> bool:
        """Add a message that is not consecutive. Return False if it was backfilled before.

        `content` is a hash of its payload. Its time is no sign of it: if the clock of its publisher is ahead, each
        receiver puts its own time on it, but a backfill brings the time of the publisher.
        """
        known = self.senders.get(sender)
        if known is None:
            self._begin(sender, number)
            return True
        ahead = (number - known.last) % _MODULO
        if 0 < ahead < _BACKWARD:
            self._skip(known, known.last, ahead)
            known.last = number
            return True
        if self._early.get((sender, number)) == content:
            del self._early[sender, number]
            return False
        if known.fill(number):  # a newer backfilled message came before it
            return True
        if (sender, known.first) in self._early and self._precede(known, number):  # only answers have come before it
            return True
        self._restart(known, number)  # the sender restarted its count, so this is not a gap of four billion messages
        return True

    def add_dropped(self, sender: Hashable, number: int, count: int) -> None:
        """Add a gap of `count` messages that came but were dropped. `number` is that of the last one."""
        known = self.senders.get(sender)
        if known is None:
            known = self._begin(sender, (number - count) % _MODULO)
            known.first = (number - count + 1) % _MODULO
        ahead = (number - known.last) % _MODULO
        if 0 < ahead < _BACKWARD:
            self._skip(known, known.last, ahead + 1)
            known.last = number

    def is_missing(self, sender: Hashable, number: int) -> bool:
        """Return True if this number of a sender is in a gap that a backfill may close."""
        known = self.senders.get(sender)
        return known is not None and any(number in gap for gap in (*known.gaps, *known.earlier_gaps))

    def add_backfilled(self, sender: Hashable, number: int, content: int) -> bool:
        """Add a backfilled message. Return False if it is a duplicate. `content` is as for `add_live`."""
        known = self.senders.get(sender)
        if known is None:
            self._begin(sender, number)
            self._expect(sender, number, content)
        elif 0 < (ahead := (number - known.last) % _MODULO) < _BACKWARD:
            self._skip(known, known.last, ahead)
            known.last = number
            self._expect(sender, number, content)
        elif not (self._precede(known, number) or known.fill(number)):
            return False
        elif (sender, known.last) in self._early:  # the original of a newer one has not arrived, so this one's may
            self._expect(sender, number, content)
        return True

    def _expect(self, sender: Hashable, number: int, content: int) -> None:
        """Remember a backfilled message whose original may still arrive."""
        # Only the newest ones can still arrive, because publications of one publisher keep their order.
        self._early[sender, number] = content
        if len(self._early) > MAX_EARLY_BACKFILLS:
            del self._early[next(iter(self._early))]

    def _begin(self, sender: Hashable, number: int) -> TrackedSender:
        """Add a sender. Messages before its first number precede this recording, and are not a gap."""
        if len(self.senders) >= MAX_TRACKED_SOURCES:
            oldest = min(self.senders, key=lambda each: self.senders[each].heard_ns)  # silent for the longest time
            self._lost += sum(gap.count for gap in self.senders.pop(oldest).gaps)
            self._forgotten[oldest] = None
            if len(self._forgotten) > MAX_FORGOTTEN_SOURCES:
                del self._forgotten[next(iter(self._forgotten))]
        self.senders[sender] = known = TrackedSender(number, number)
        return known

    def _precede(self, known: TrackedSender, number: int) -> bool:
        """Add a message before the first one, with the gap between them. Return False if it is not before it."""
        before = (known.first - number) % _MODULO
        if not 0 < before < _BACKWARD:
            return False
        self._skip(known, number, before)
        known.first = number
        return True

    def _restart(self, known: TrackedSender, number: int) -> None:
        self._lost += sum(gap.count for gap in known.gaps)
        known.gaps.clear()
        known.earlier_gaps = []
        known.last = known.first = number

    def _skip(self, known: TrackedSender, below: int, distance: int) -> None:
        """Add the gap between two received numbers."""
        if distance == 1:
            return
        first, last = (below + 1) % _MODULO, (below + distance - 1) % _MODULO
        if first > last:  # the gap spans the wrap
            known.gaps.append(Gap(first, _MODULO - 1))
            first = 0
        known.gaps.append(Gap(first, last))
        while len(known.gaps) > MAX_OPEN_GAPS:
            self._lost += known.gaps.pop(0).count


class PublisherSequence(Struct):
    """Tracks the recorded messages of one publisher on one key."""

    restarts: bool = False
    """True if the count may restart. A number that neither grows nor fills a gap is then a restart. If False, such
    a number is a duplicate.

    The `seq` of a payload never restarts within one `boot_id`. Zenoh's number begins again with each new publisher. But
    a backfill may also bring messages from before the first one. They were published before it, so they are no restart.
    """
    first: int = 0
    last: int = 0
    count: int = 0
    duplicates: int = 0
    unlisted: int = 0
    """Number of missing messages in gaps beyond MAX_LISTED_GAPS."""
    gaps: list[Gap] = field(default_factory=list)
    _last_ns: int = 0
    _first_published_ns: int = 0

    @property
    def missing(self) -> int:
        """Return the number of missing messages."""
        return sum(gap.count for gap in self.gaps) + self.unlisted

    def add(self, number: int, received_ns: int, published_ns: int) -> bool:
        """Add the next message in the order of the file. Return True if it is the newest."""
        self.count += 1
        if self.count == 1:
            self.first = self.last = number
            self._first_published_ns = published_ns
        elif number == self.last + 1:
            self.last = number
        elif number > self.last:
            self._add_gap(Gap(self.last + 1, number - 1, self._last_ns, received_ns))
            self.last = number
        elif _fill(self.gaps, number):
            return False
        elif number < self.first and (not self.restarts or published_ns < self._first_published_ns):
            if number < self.first - 1:
                self._add_gap(Gap(number + 1, self.first - 1, received_ns, received_ns))
            self.first, self._first_published_ns = number, published_ns
            return False
        elif self.restarts:
            self.last = number
        else:
            self.duplicates += 1
            return False
        self._last_ns = received_ns
        return True

    def _add_gap(self, gap: Gap) -> None:
        if len(self.gaps) < MAX_LISTED_GAPS:
            self.gaps.append(gap)
        else:
            self.unlisted += gap.count
