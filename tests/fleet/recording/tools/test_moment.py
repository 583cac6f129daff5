"""What was known at a moment is what the tables of the session say, and so are the lanes."""

import random
from typing import Any

import pytest

from fleet.recording.reading.session import Session
from fleet.recording.tools.car_timeline import STATE_BEFORE_NS
from fleet.recording.tools.lanes import HELD_NS, Lane
from fleet.recording.tools.moment import known_at, lanes_of, newest_rows
from schemas.topics import CAR_TOPICS
from tests.fleet.replay.make_session import START_NS, make
from tests.support.soaks import only_in_soak
from tests.support.sorted_writer import SortedWriter

SECONDS = 120
COUNTS = pytest.mark.parametrize("count", [25, *only_in_soak([100])])
"""Number of moments."""
TABLES = [topic for topic in CAR_TOPICS if topic.family in ("sensor", "state", "sim")]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("moments") / "made.mcap"
    make(path, SECONDS, SortedWriter)
    return Session(path)


def moments(count: int) -> list[int]:
    chance = random.Random(31)
    return [
        START_NS + chance.randrange(-5, SECONDS + 40) * 1_000_000_000 + chance.randrange(10**9) for _ in range(count)
    ]


@COUNTS
def test_past_state_equals_tables_at_random_moments(session: Session, count: int) -> None:
    tables: dict[str, Any] = {topic.name: session.to_pandas(topic.name) for topic in TABLES}
    times = {
        name: (table["log_time"].astype("int64"), table["publish_time"].astype("int64"))
        for name, table in tables.items()
    }
    compared = 0
    for at_ns in moments(count):
        found = {str(each.key): each.message.seq for each in known_at(session, at_ns) if each.key.topic in tables}
        told: dict[str, int] = {}
        for name, table in tables.items():
            logged, published = times[name]
            known = table[(logged <= at_ns) & (logged > at_ns - STATE_BEFORE_NS)]
            for key, rows in known.groupby("key"):
                told[str(key)] = int(rows["sequence"].loc[published[rows.index].idxmax()])
        assert found == told, at_ns
        compared += len(told)
    assert compared > count * 20


@COUNTS
def test_lanes_equal_tables_at_random_moments(session: Session, count: int) -> None:
    modes, lanes = session.to_pandas("state/mode"), lanes_of(session)
    by_log = modes.assign(log_ns=modes["log_time"].astype("int64")).sort_values("log_ns")
    seen = set()
    for at_ns in moments(count):
        told = {}
        for car, rows in by_log.groupby("car"):
            before, after = rows[rows["log_ns"] <= at_ns], rows[rows["log_ns"] >= at_ns]
            # A mode lasts to the next word of it; after the last word, nobody knows.
            if len(before) and len(after) and after["log_ns"].iloc[0] - before["log_ns"].iloc[-1] <= HELD_NS:
                told[car] = before["asked"].iloc[-1]
        found = {car: span.words for (car, lane), span in lanes.at(at_ns).items() if lane is Lane.MODE}
        assert found == told, at_ns
        seen |= set(told.values())
    assert seen == {"manual", "tracking", "obstacle_avoidance"}
    assert [each.words for each in lanes.marks] == ["here it gets interesting"]


def test_of_two_messages_the_one_that_was_published_later_counts() -> None:
    def row(publish_ns: int, data: bytes) -> Any:
        info: Any = type("Info", (), {"channel": type("Channel", (), {"topic": "fleet/red/state/mode"})})
        return info, 0, 0, publish_ns, data

    newest = newest_rows([row(5, b"a"), row(7, b"b"), row(6, b"late"), row(7, b"c")])
    assert [each[4] for each in newest.values()] == [b"c"]
