"""Decides which publishers a backfill asks, when, and how far back. Pure: times are of one monotonic clock, s.

When should the recorder ask? After its own link to the hub is back: it asks all. After a gap in the numbers of a
publisher, which shows that the *car* was cut off: it asks all publishers of this car, because some of them are silent
for minutes. If the car's state has a gap, its next command event may have one too, but shows it only when it comes, and
after the last command none comes. And the recorder asks at the start, if it continues an interrupted session.

One query is not enough, because others may reconnect half a second later than we do, and on a loaded machine even
later. So each cause plans several (`QUERY_AFTER_...`). Their answers overlap, but that does no harm: every message has
a number, and the writer knows which ones it has. And a link that is back may be lost again before anybody was asked. So
a source that did not answer its last query stays on the list: it is asked again with its next cause, from the time at
which its first gap began, and once more at the end of the recording.

How far back should it ask? The window of a query is relative ("the last 13 s"), and the publisher counts it back from
the arrival of the query, with its own clock. So it works even if that clock is wrong by an hour, unlike an absolute
time. But every delay of the query moves the window forward, and the oldest missing message falls out of it. So the plan
says since when, and the length is computed just before each query. Gaps have a margin for the delay.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

from msgspec import Struct

QUERY_AFTER_START_S: Final = (1.0,)
"""Delay of the query after the start. It is for publishers that started with us and may have missed our
subscription."""
QUERY_AFTER_RECONNECT_S: Final = (0.3, 1.0, 2.0, 4.0)
"""Delays of the queries after a reconnect. Other clients reconnect within half a second, or later on a loaded
machine."""
QUERY_AFTER_GAP_S: Final = (0.0, 1.0, 3.0)
GAP_MARGIN_S: Final = 2.0
"""Margin of a window for two delays of the network. The last message before the gap was published before it arrived, so
the gap may begin earlier than that. And the publisher counts the window back from the late arrival of the query."""
MAX_SINGLE_SOURCES: Final = 16
"""Maximum number of sources to ask one by one. If there are more, ask everything."""
EVERYTHING: Final = ""
"""The source that stands for all of them."""


class PlannedQuery(Struct, frozen=True):
    """Ask this source, or EVERYTHING, for what it has published since this time."""

    source: str
    since: float


class _Asked(Struct):
    """A source that has to be asked. `due` is empty if it waits for its next cause."""

    since: float
    due: list[float]


class BackfillPlan:
    """The queries of one recorder. A source is a car or a service: the first two chunks of its keys."""

    def __init__(self, now: float, *, resume_since: float | None = None) -> None:
        """Begin. `resume_since`: when the interrupted session ended that this one continues."""
        self._asked: dict[str, _Asked] = {}
        if resume_since is None:
            self._plan(EVERYTHING, now, QUERY_AFTER_START_S, now)
        else:
            self._plan(EVERYTHING, resume_since, (0.0, *QUERY_AFTER_START_S), now)

    def add_gaps(self, gaps: Mapping[str, float], silent_since: float, now: float) -> None:
        """Plan queries for gaps: keys, each with the time of the last message before its gap.

        `silent_since`: the earliest time since which a link may have been lost without our notice.
        """
        for key, since in gaps.items():
            self._plan(source_of(key), min(silent_since, since - GAP_MARGIN_S), QUERY_AFTER_GAP_S, now)

    def add_reconnect(self, since: float, now: float) -> None:
        """Plan queries after our own link was lost, which was whole until `since`."""
        for source in (EVERYTHING, *(each for each, asked in self._asked.items() if not asked.due)):
            self._plan(source, since, QUERY_AFTER_RECONNECT_S, now)

    def due_queries(self, now: float) -> list[PlannedQuery]:
        """Return the queries that are due."""
        due = [source for source, asked in self._asked.items() if asked.due and asked.due[0] <= now]
        for source in due:
            asked = self._asked[source]
            asked.due = [each for each in asked.due if each > now]
        return self._queries(due)

    def last_queries(self) -> list[PlannedQuery]:
        """Return the queries at the end of the recording: of all that may still be missing."""
        for asked in self._asked.values():
            asked.due = []
        return self._queries(self._asked)

    def add_answers(self, query: PlannedQuery, keys_answered: Iterable[str]) -> None:
        """Forget the sources of this query that have answered their last one."""
        answered: set[str] = {EVERYTHING} if query.source == EVERYTHING else set()
        answered.update(source_of(key) for key in keys_answered)
        for source in answered:
            if source in self._asked and not self._asked[source].due:
                del self._asked[source]

    def _plan(self, source: str, since: float, after: Sequence[float], now: float) -> None:
        asked = self._asked.setdefault(source, _Asked(since, []))
        asked.since = min(asked.since, since)
        planned = [now + each for each in after]
        asked.due = [*planned, *(each for each in asked.due if each > planned[-1])]

    def _queries(self, sources: Collection[str]) -> list[PlannedQuery]:
        if not sources:
            return []
        if EVERYTHING in sources or len(sources) > MAX_SINGLE_SOURCES:
            return [PlannedQuery(EVERYTHING, min(self._asked[each].since for each in sources))]
        return [PlannedQuery(each, self._asked[each].since) for each in sorted(sources)]


def source_of(key: str) -> str:
    """Return the car or the service that publishes a key, as its first two chunks: `fleet/red`."""
    return "/".join(key.split("/", 2)[:2])
