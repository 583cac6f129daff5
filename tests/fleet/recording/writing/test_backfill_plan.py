"""Each gap is asked for until its publisher has answered, and a search over links that are lost at bad moments."""

import random
from collections.abc import Sequence

import pytest

from fleet.recording.writing.backfill_plan import (
    EVERYTHING,
    GAP_MARGIN_S,
    MAX_ANSWERS_OF_OTHERS,
    MAX_SINGLE_SOURCES,
    QUERY_AFTER_GAP_S,
    QUERY_AFTER_NEWCOMER_S,
    QUERY_AFTER_RECONNECT_S,
    QUERY_AFTER_START_S,
    QUERY_INTERVAL_S,
    BackfillPlan,
    PlannedQuery,
    source_of,
)

NOW = 1000.0
LEASE_S = 2.0
ROUTED_AFTER_S = 0.5
"""Time after which a restored link carries queries. Messages come at once."""
STATE, EVENT = "fleet/blue/state/link", "fleet/blue/event/command"


def started(at: float = NOW - 10.0) -> BackfillPlan:
    """Return a plan that has asked what it asks at the start."""
    plan = BackfillPlan(at)
    answer(plan, plan.due_queries(NOW))
    assert not plan.last_queries()
    return plan


def answer(plan: BackfillPlan, queries: Sequence[PlannedQuery], *keys: str) -> None:
    for query in queries:
        plan.add_answers(query, keys)


def asked_at(plan: BackfillPlan, until: float, *keys: str) -> list[tuple[float, PlannedQuery]]:
    """Return the queries until then with their delays, all of them answered with messages of these keys."""
    found = []
    for step in range(round((until - NOW) * 10) + 1):
        now = NOW + step / 10
        for query in plan.due_queries(now):
            found.append((round(now - NOW, 1), query))
            plan.add_answers(query, keys)
    return found


def test_gap_asks_all_publishers_of_its_car_since_the_gap() -> None:
    plan = started()
    plan.add_gaps({STATE: NOW - 30.0}, NOW - 2.0, NOW)
    query = PlannedQuery("fleet/blue", NOW - 30.0 - GAP_MARGIN_S)
    assert asked_at(plan, NOW + 10.0, STATE) == [(after, query) for after in QUERY_AFTER_GAP_S]
    assert not plan.last_queries()


def test_young_gap_asks_for_the_whole_lease() -> None:
    plan = started()
    plan.add_gaps({STATE: NOW - 0.1}, NOW - 5.0, NOW)
    assert plan.due_queries(NOW) == [PlannedQuery("fleet/blue", NOW - 5.0)]


def test_start_asks_everything_and_resumed_session_at_once() -> None:
    plan = BackfillPlan(NOW)
    assert asked_at(plan, NOW + 5.0) == [(after, PlannedQuery(EVERYTHING, NOW)) for after in QUERY_AFTER_START_S]
    plan = BackfillPlan(NOW, resume_since=NOW - 30.0)
    resumed = PlannedQuery(EVERYTHING, NOW - 30.0)
    assert asked_at(plan, NOW + 5.0) == [(after, resumed) for after in (0.0, *QUERY_AFTER_START_S)]


def test_reconnect_asks_everything_since_the_link_was_whole() -> None:
    plan = started()
    plan.add_reconnect(NOW - 7.0, NOW)
    query = PlannedQuery(EVERYTHING, NOW - 7.0)
    assert asked_at(plan, NOW + 10.0) == [(after, query) for after in QUERY_AFTER_RECONNECT_S]


@pytest.mark.parametrize("cause", ["gap", "reconnect", "end"])
def test_car_that_did_not_answer_is_asked_again_since_its_first_gap(cause: str) -> None:
    plan = started()
    plan.add_gaps({EVENT: NOW - 30.0}, NOW - 2.0, NOW)
    plan.add_gaps({"fleet/red/state/link": NOW - 3.0}, NOW - 2.0, NOW)
    assert asked_at(plan, NOW + 10.0, "fleet/red/state/link")
    if cause == "gap":
        plan.add_gaps({STATE: NOW + 9.0}, NOW + 8.0, NOW + 10.0)
        queries = plan.due_queries(NOW + 10.0)
    elif cause == "reconnect":
        plan.add_reconnect(NOW + 8.0, NOW + 10.0)
        queries = plan.due_queries(NOW + 11.0)
    else:
        queries = plan.last_queries()
    (query,) = queries
    assert query.source == (EVERYTHING if cause == "reconnect" else "fleet/blue")
    assert query.since == NOW - 30.0 - GAP_MARGIN_S


def test_newcomer_is_asked_for_everything_since_the_begin() -> None:
    plan = started()
    plan.add_newcomers({STATE: "fleet/blue", EVENT: "fleet/blue"}, NOW)
    query = PlannedQuery("fleet/blue", NOW - 10.0 - GAP_MARGIN_S)
    assert asked_at(plan, NOW + 10.0, STATE, EVENT) == [(after, query) for after in QUERY_AFTER_NEWCOMER_S]
    assert not plan.last_queries()


def test_first_stop_of_a_fleet_asks_for_the_events_alone() -> None:
    """The window since the begin is for these keys, also if all cars are asked for the last seconds at that time."""
    plan = started(NOW - 1000.0)
    events = [f"fleet/car{number}/event/command" for number in range(2 * MAX_SINGLE_SOURCES)]
    plan.add_newcomers({each: each for each in events}, NOW)
    plan.add_reconnect(NOW - 1.0, NOW - QUERY_AFTER_RECONNECT_S[0])
    asked = plan.due_queries(NOW)
    assert asked[0] == PlannedQuery(EVERYTHING, NOW - 1.0)
    assert {each.source: each.since for each in asked[1:]} == dict.fromkeys(events, NOW - 1000.0 - GAP_MARGIN_S)
    for query in [*asked, *plan.due_queries(NOW + QUERY_AFTER_NEWCOMER_S[-1])]:
        plan.add_answers(query, [query.source] if query.source else events)
    assert {each.source for each in plan.last_queries()} == {EVERYTHING}


def test_answer_of_all_for_a_younger_gap_does_not_count() -> None:
    """A car had not answered for an older gap, and was forgotten because all were asked for the last seconds."""
    plan = started()
    plan.add_gaps({STATE: NOW - 30.0}, NOW - 2.0, NOW)
    plan.due_queries(NOW + 10.0)
    answer(plan, [PlannedQuery(EVERYTHING, NOW - 5.0)], STATE)
    assert plan.last_queries() == [PlannedQuery("fleet/blue", NOW - 30.0 - GAP_MARGIN_S)]
    answer(plan, [PlannedQuery(EVERYTHING, NOW - 40.0)], STATE)
    assert plan.last_queries() == []


def test_many_sources_are_asked_at_once() -> None:
    plan = started()
    plan.add_gaps({f"fleet/car{number}/state/link": NOW - number for number in range(MAX_SINGLE_SOURCES)}, NOW, NOW)
    assert len(plan.due_queries(NOW)) == MAX_SINGLE_SOURCES
    plan.add_gaps({STATE: NOW - 99.0}, NOW, NOW)
    plan.add_gaps({f"fleet/car{number}/state/link": NOW - number for number in range(MAX_SINGLE_SOURCES)}, NOW, NOW)
    assert plan.due_queries(NOW + QUERY_INTERVAL_S) == [PlannedQuery(EVERYTHING, NOW - 99.0 - GAP_MARGIN_S)]


def test_answers_of_another_publisher_of_the_car_do_not_count() -> None:
    plan = started()
    plan.add_gaps({EVENT: NOW - 30.0}, NOW - 2.0, NOW)
    assert asked_at(plan, NOW + 10.0, "fleet/blue/sensor/pose")
    (query,) = plan.last_queries()
    assert query == PlannedQuery("fleet/blue", NOW - 30.0 - GAP_MARGIN_S)
    plan.add_answers(query, [EVENT])
    assert not plan.last_queries()


@pytest.mark.parametrize("answered", [[STATE], [EVENT]])
def test_car_that_loses_messages_all_the_time_is_asked_once_a_second(answered: list[str]) -> None:
    """The publisher of a key without an answer has no cache."""
    plan, asked, longest_s = started(), 0, 0.0
    for step in range(300):
        now = NOW + step / 5
        plan.add_gaps({STATE: now - 0.2}, now - 2.0, now)
        for query in plan.due_queries(now):
            asked, longest_s = asked + 1, max(longest_s, now - query.since)
            plan.add_answers(query, answered)
    assert 55 <= asked <= 62
    assert longest_s < (5.0 if answered == [STATE] else 5.0 + MAX_ANSWERS_OF_OTHERS)


@pytest.mark.parametrize(
    ("key", "source"),
    [
        (STATE, "fleet/blue"),
        ("fleet/@recorder/north/status", "fleet/@recorder"),
        ("fleet/@recorder/status", "fleet/@recorder"),
        ("fleet/map", "fleet/map"),
    ],
)
def test_source_is_a_car_or_a_service(key: str, source: str) -> None:
    assert source_of(key) == source


class LossyCar:
    """A car that publishes a state each second, and seldom an event, over a link that is lost at random."""

    def __init__(self, name: str, rng: random.Random) -> None:
        self.rng = rng
        self.keys = (f"fleet/{name}/state/link", f"fleet/{name}/event/command")
        self.published: dict[str, list[float]] = {key: [] for key in self.keys}
        self.recorded: dict[str, set[int]] = {key: set() for key in self.keys}
        self.heard_at = dict.fromkeys(self.keys, NOW)
        self.is_linked = True
        self.lost_at = self.restored_at = NOW

    def move_link(self, lost_share: float, back_share: float, now: float) -> None:
        """Lose the link, or restore it after its lease at the earliest."""
        if self.is_linked and self.rng.random() < lost_share:
            self.is_linked, self.lost_at = False, now
        elif not self.is_linked and now - self.lost_at > LEASE_S and self.rng.random() < back_share:
            self.is_linked, self.restored_at = True, now

    def publish(self, key: str, now: float) -> dict[str, float]:
        """Publish once. Return the gap that it shows to the recorder."""
        numbers = self.recorded[key]
        self.published[key].append(now)
        if not self.is_linked:
            return {}
        number, newest = len(self.published[key]), max(numbers, default=None)
        gap = {key: self.heard_at[key]} if newest is not None and number != newest + 1 else {}
        numbers.add(number)
        self.heard_at[key] = now
        return gap

    def recall(self, since: float, now: float) -> list[str]:
        """Answer a query. Return the keys of the answers."""
        if not self.is_linked or now - self.restored_at < ROUTED_AFTER_S:
            return []
        found = [(key, n) for key in self.keys for n, at in enumerate(self.published[key], 1) if at >= since]
        for key, number in found:
            self.recorded[key].add(number)
        return [key for key, _ in found]

    @property
    def missing(self) -> dict[str, set[int]]:
        wanted = {key: set(range(1, len(at) + 1)) for key, at in self.published.items()}
        return {key: numbers - self.recorded[key] for key, numbers in wanted.items() if numbers - self.recorded[key]}


@pytest.mark.parametrize("seed", range(100))
def test_nothing_is_missing_at_the_end_if_each_car_is_back(seed: int) -> None:
    """The links hold for the last seconds only. Each car is heard before they break for the first time."""
    rng = random.Random(seed)
    cars = [LossyCar(f"car{number}", rng) for number in range(rng.choice((1, 2, MAX_SINGLE_SOURCES + 4)))]
    plan, asked = BackfillPlan(NOW), 0
    lost_share, back_share = rng.choice((0.01, 0.1, 0.5)), rng.choice((0.02, 0.1, 0.5))
    now, length, gaps = NOW, rng.randrange(100, 900), 0
    for step in range(length):
        now = NOW + step * 0.2
        found: dict[str, float] = {}
        for car in cars:
            if step > 10:
                is_near_end = step > length - 25
                car.move_link(0.0 if is_near_end else lost_share, 1.0 if is_near_end else back_share, now)
            if step % 5 == 0:
                found |= car.publish(car.keys[0], now)
            if step < 5 or rng.random() < 0.01:
                found |= car.publish(car.keys[1], now)
        gaps += len(found)
        plan.add_gaps(found, now - 2.0, now)
        for query in plan.due_queries(now):
            asked += 1
            plan.add_answers(query, answers(cars, query, now))
    for query in plan.last_queries():
        plan.add_answers(query, answers(cars, query, now))
    assert {key: numbers for car in cars for key, numbers in car.missing.items()} == {}
    assert asked <= 1 + len(QUERY_AFTER_GAP_S) * gaps
    assert plan.last_queries() == []


def answers(cars: Sequence[LossyCar], query: PlannedQuery, now: float) -> list[str]:
    return [
        key
        for car in cars
        if query.source in (EVERYTHING, source_of(car.keys[0]))
        for key in car.recall(query.since, now)
    ]
