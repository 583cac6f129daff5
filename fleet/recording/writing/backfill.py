"""Asking publishers again for what a recorder missed: when, and for how long back. What is new is tape.py's to say.

Publishers hold ten seconds at their topic's rate, a hundred publications at least (`Topic.held`): of a state minutes,
of an event hours. They are asked after a hub was away, after a gap in their numbers, and by a recorder that goes on for
one that was killed.
"""

import threading
import time
from collections import deque
from collections.abc import Collection, Sequence
from typing import Final

import zenoh

from fleet.recording.writing.resume import TAIL_S
from schemas.bus import Bus

LOOK_S: Final = 0.2
AFTER_START_S: Final = (1.0,)
"""A publisher that began in the moment in which we did may not have known of us."""
AFTER_HUB_S: Final = (0.3, 1.0, 2.0, 4.0)
"""Others are back later than we are: clients try again after half a second at most, and may be held up."""
AFTER_GAP_S: Final = (0.0, 1.0, 3.0)
LOOKS: Final = round(2.0 / LOOK_S)
"""A link is gone for two seconds before it is noticed (Zenoh's lease): in looks, since who stands still has none."""
FEW: Final = 16
"""Of more keys than that everything is asked at once."""
MOST: Final = 200_000
"""Answers that wait for the writer; what is over is asked again."""


class Backfill:
    """Asks from a thread of its own, from `start` to `close`."""

    def __init__(self, bus: Bus, expressions: Sequence[str], *, follows: bool) -> None:
        self._bus = bus
        # A stream of commands comes from a client that holds nothing.
        self._all = tuple(expression for expression in expressions if "@cmd" not in expression)
        self._lock = threading.Lock()
        self._gaps: set[str] = set()
        self._found: list[zenoh.Sample] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recall")
        now = time.monotonic()
        self._due = [now + after for after in ((0.0,) if follows else ()) + AFTER_START_S]
        self._from = now - (TAIL_S if follows else 0.0)
        self._every = True
        self._keys: set[str] = set()

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def close(self) -> None:
        """Ask a last time if something is missing, and end."""
        self._closing.set()
        self._thread.join()

    def ask(self, keys: Collection[str]) -> None:
        """Numbers are missing under these keys."""
        with self._lock:
            self._gaps.update(keys)

    def taken(self) -> list[zenoh.Sample]:
        """What has been answered since the last time; some of it is known already."""
        with self._lock:
            found, self._found = self._found, []
        return found

    def _run(self) -> None:
        hubs = self._bus.hubs
        looks = deque([time.monotonic()], LOOKS)
        whole_at = looks[0]
        while not self._closing.wait(LOOK_S):
            now, there = time.monotonic(), self._bus.hubs
            with self._lock:
                gaps, self._gaps = self._gaps, set()
            if gaps:
                self._plan(AFTER_GAP_S, looks[0], gaps)
            if there and there != hubs:
                self._plan(AFTER_HUB_S, whole_at, None)
            hubs = there
            if there:
                whole_at = looks[0]
            looks.append(now)
            if there and self._due and self._due[0] <= now:
                self._due = [due for due in self._due if due > now]
                self._ask_now()
                if not self._due:
                    self._every, self._keys = False, set()
        with self._lock:
            gaps = self._gaps
        if gaps or self._due:
            self._plan((), looks[0], gaps or None)
            self._ask_now()

    def _plan(self, after: Sequence[float], since: float, keys: set[str] | None) -> None:
        now = time.monotonic()
        self._from = min(self._from, since) if self._due else since
        self._due = sorted([*self._due, *(now + each for each in after)])
        if keys is None:
            self._every = True
        else:
            self._keys |= keys

    def _ask_now(self) -> None:
        last_s = time.monotonic() - self._from
        every = self._every or len(self._keys) > FEW
        for expression in self._all if every else sorted(self._keys):
            found = []
            for sample in self._bus.recall(expression, last_s):
                found.append(sample)
                if len(found) + len(self._found) > MOST:
                    break
            with self._lock:
                self._found += found
