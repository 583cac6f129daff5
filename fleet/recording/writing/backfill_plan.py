"""Decides which publishers a backfill asks, when, and how far back. Pure: times are of one monotonic clock, s.

When should the recorder ask? After its own link to the hub is back: it asks all. After a gap in the numbers of a
publisher, which shows that the *car* was cut off: it asks all publishers of this car, because some of them are silent
for minutes. The command events of this car may have a gap, too. Only the next event would show it, and after the last
command there is no next event. When a sender is heard for the first time, but not from its first message on, it may
have published without a link: the recorder asks this car, too, since the begin of the recording. But most cars are
heard at once, and their command events only at the first command. Then it asks for the key alone: otherwise, the first
stop of the whole fleet would call up all that all cars have cached. And the recorder asks shortly after its start. If
it continues an interrupted session, it asks at once, too, and further back.

One query is not enough, because others may reconnect half a second later than we do, and on a loaded machine even
later. So a reconnect and a gap plan several queries each (`QUERY_AFTER_...`). Their answers overlap, but that does no
harm: every message has a number, and the writer knows which ones it has. And a link that is back may be lost again
before anybody was asked. So the plan remembers a source, which is a car or a service, until its answers contain every
key that has a gap. It asks this source again at the next reconnect or gap, from the time at which its first gap began,
and once more at the end of the recording.

How far back should it ask? The window of a query is relative ("the last 13 s"), and the publisher counts it back from
the arrival of the query, with its own clock. So it works even if that clock is wrong by an hour, unlike an absolute
time. But every delay of the query moves the window forward, and the oldest missing message falls out of it. So the plan
says since when, and the length is computed just before each query. Gaps have a margin for the delay.
"""

from collections.abc import Collection, Mapping, Sequence
from math import inf
from typing import Final

from msgspec import Struct, field

QUERY_AFTER_START_S: Final = (1.0,)
"""Delay of the query after the start. It is for publishers that started with us and may have missed our
subscription."""
QUERY_AFTER_RECONNECT_S: Final = (0.3, 1.0, 2.0, 4.0)
"""Delays of the queries after a reconnect. Other clients reconnect within half a second, or later on a loaded
machine."""
QUERY_AFTER_GAP_S: Final = (0.0, 1.0, 3.0)
QUERY_AFTER_NEWCOMER_S: Final = (0.0, 1.0)
"""Delays of the queries after a sender was heard for the first time, but not from its first message on."""
QUERY_INTERVAL_S: Final = 1.0
"""Minimum time between two first queries of one source. Otherwise, on a network that loses messages all the time, a car
would be asked for all of its messages five times a second."""
GAP_MARGIN_S: Final = 2.0
"""Margin of a window for two delays of the network. The last message before the gap was published before it arrived, so
the gap may begin earlier than that. And the publisher counts the window back from the late arrival of the query."""
MAX_ANSWERS_OF_OTHERS: Final = 10
"""A key is given up after this many answers of its source that do not contain it: its publisher has no cache."""
MAX_SINGLE_SOURCES: Final = 16
"""Maximum number of sources to ask one by one. If there are more, ask everything."""
EVERYTHING: Final = ""
"""The source that stands for all of them."""


class PlannedQuery(Struct, frozen=True):
    """Ask this source, which may also be a key, or EVERYTHING, for what it has published since this time."""

    source: str
    since: float


class _Asked(Struct):
    """A source to ask. Without `due`, the recorder asks it again at the next gap or reconnect."""

    due: list[tuple[float, float]] = field(default_factory=list)
    """When to ask, and since when messages may be missing."""
    unanswered_since: float = inf
    """The earliest time from which messages were asked for without a complete answer so far, or inf."""
    keys: dict[str, int] = field(default_factory=dict)
    """Keys with gaps, each with the number of answers that did not contain it. A car has several publishers, so an
    answer of another one does not count as an answer for this key."""
    asked_at: float = -inf


class BackfillPlan:
    """The queries of one recorder. A source is a car or a service, the first two chunks of its keys, or one key."""

    def __init__(self, now: float, *, resume_since: float | None = None) -> None:
        """Begin. `resume_since`: the time from which to ask if this recording continues an interrupted session."""
        self._asked: dict[str, _Asked] = {}
        self._begin = now if resume_since is None else resume_since
        at_once = () if resume_since is None else (0.0,)
        self._plan(EVERYTHING, self._begin, (*at_once, *QUERY_AFTER_START_S), now)

    def add_gaps(self, gaps: Mapping[str, float], silent_since: float, now: float) -> None:
        """Plan queries for gaps: keys, each with the time of the last message before its gap.

        `silent_since`: the earliest time since which a link may have been lost without our notice.
        """
        since: dict[str, float] = {}
        for key, at in gaps.items():
            source = source_of(key)
            since[source] = min(since.get(source, silent_since), at - GAP_MARGIN_S)
        for source, at in since.items():
            self._plan(source, at, QUERY_AFTER_GAP_S, now)
        for key in gaps:
            self._asked[source_of(key)].keys.setdefault(key, 0)

    def add_newcomers(self, sources: Mapping[str, str], now: float) -> None:
        """Plan queries for keys whose senders have published before they were heard, each with the source to ask."""
        for source in set(sources.values()):
            self._plan(source, self._begin - GAP_MARGIN_S, QUERY_AFTER_NEWCOMER_S, now)
        for key, source in sources.items():
            self._asked[source].keys.setdefault(key, 0)

    def add_reconnect(self, since: float, now: float) -> None:
        """Plan queries after our own link was lost, which was whole until `since`."""
        self._plan(EVERYTHING, since, QUERY_AFTER_RECONNECT_S, now)
        for source, asked in self._asked.items():
            if not asked.due:
                self._plan(source, since, QUERY_AFTER_RECONNECT_S, now)

    def due_queries(self, now: float) -> list[PlannedQuery]:
        """Return the queries that are due."""
        return self._queries(
            [source for source, asked in self._asked.items() if asked.due and asked.due[0][0] <= now], now
        )

    def last_queries(self) -> list[PlannedQuery]:
        """Return the queries at the end of the recording: of all that may still be missing. Plan nothing after it."""
        return self._queries(self._asked, inf)

    def add_answers(self, query: PlannedQuery, answered: Collection[str]) -> None:
        """Take the keys in a complete answer, which did not break off.

        Forget a source for which no query is due, if all its keys with gaps were answered or given up.
        """
        for source in {EVERYTHING, *map(source_of, answered)} if query.source == EVERYTHING else {query.source}:
            asked = self._asked.get(source)
            if asked is None or not (answered or source == EVERYTHING):
                continue
            if query.since > asked.unanswered_since:  # a query of all sources that was for younger gaps
                continue
            asked.keys = {key: count + 1 for key, count in asked.keys.items() if key not in answered}
            if any(count < MAX_ANSWERS_OF_OTHERS for count in asked.keys.values()):
                continue
            asked.unanswered_since, asked.keys = inf, {}
            if not asked.due:
                del self._asked[source]

    def asks_for_all(self, query: PlannedQuery) -> bool:
        """Return True if a query asks a car, or all, for everything since the begin of the recording."""
        return query.since <= self._begin and source_of(query.source) == query.source

    def _plan(self, source: str, since: float, after: Sequence[float], now: float) -> None:
        if not after:
            return
        asked = self._asked.setdefault(source, _Asked())
        begin = max(now, asked.asked_at + QUERY_INTERVAL_S)
        planned = [(begin + each, since) for each in after]
        # A query that was planned before and is due within this schedule is not needed, but the time since which it
        # wanted to ask is.
        earliest = min([since, *(each for at, each in asked.due if at <= planned[-1][0])])
        asked.due = [(planned[0][0], earliest), *planned[1:], *(each for each in asked.due if each[0] > planned[-1][0])]

    def _queries(self, sources: Collection[str], now: float) -> list[PlannedQuery]:
        since: dict[str, float] = {}
        for source in sources:
            asked = self._asked[source]
            served = [each for at, each in asked.due if at <= now]
            asked.due = [each for each in asked.due if each[0] > now]
            asked.asked_at = now
            since[source] = asked.unanswered_since = min([asked.unanswered_since, *served])
        keys = [PlannedQuery(each, since.pop(each)) for each in sorted(since) if source_of(each) != each]
        if EVERYTHING in since or len(since) > MAX_SINGLE_SOURCES:
            return [PlannedQuery(EVERYTHING, min(since.values())), *keys]
        return [*(PlannedQuery(each, since[each]) for each in sorted(since)), *keys]


def source_of(key: str) -> str:
    """Return the car or the service that publishes a key, as its first two chunks: `fleet/red`."""
    return "/".join(key.split("/", 2)[:2])
