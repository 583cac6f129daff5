"""What the coordinator has heard of the cars, what it must still ask for, and what it forgets."""

import pytest

from fleet.coordinator.observer import FORGOTTEN_S, MOST_GONE, NEEDED, FleetObserver
from fleet.policy.decide import step
from fleet.policy.plan.parser import parse
from fleet.policy.snapshot import CarSnapshot
from fleet.policy.state import PolicyState
from schemas import messages, topics
from schemas.bus import Sample

TURN_S = 0.1


def said(topic: str, car: str = "red") -> Sample:
    name = topics.TOPICS[topic].message
    payload = messages.message_class(name)(car=car, seq=1).SerializeToString()
    return Sample(f"fleet/{car}/{topic}", payload, messages.encoding_of(name), 0, 1)


def come(hearing: FleetObserver, car: str, now: float) -> None:
    hearing.token(car, now, alive=True)
    for topic in NEEDED:
        hearing.take(said(topic, car), now, None)


def test_a_car_is_unheard_until_all_is_known_that_could_forbid_a_command() -> None:
    hearing = FleetObserver()
    assert hearing.unheard == set()
    hearing.token("red", 99.0, alive=True)
    for topic in NEEDED:
        assert hearing.unheard == {"red"}
        hearing.take(said(topic), 100.0, None)
    assert hearing.unheard == set()
    hearing.token("red", 101.0, alive=False)
    assert hearing.unheard == set(), "nobody could be asked"
    hearing.token("red", 102.0, alive=True)
    assert hearing.unheard == {"red"}, "what was known of it may no longer be so"


def test_a_car_is_forgotten_a_minute_after_its_gateway_went_but_not_one_that_is_named() -> None:
    hearing = FleetObserver({"blue": CarSnapshot(listed=True)})
    for car in ("red", "green", "blue"):
        come(hearing, car, 100.0)
        hearing.token(car, 101.0, alive=False)
    hearing.forget(101.0 + FORGOTTEN_S - 0.1, {"green"})
    assert hearing.picture(()).cars.keys() == {"red", "green", "blue"}
    hearing.forget(101.0 + FORGOTTEN_S, {"green"})
    assert hearing.picture(()).cars.keys() == hearing.picture(()).readings.keys() == {"green", "blue"}
    hearing.token("green", 200.0, alive=True)
    hearing.forget(1000.0, ())
    assert hearing.present == {"green"}


def test_a_car_that_is_back_within_the_minute_is_not_forgotten() -> None:
    hearing = FleetObserver()
    come(hearing, "red", 100.0)
    hearing.token("red", 101.0, alive=False)
    come(hearing, "red", 150.0)
    hearing.forget(300.0, ())
    assert hearing.present == {"red"}


def test_ten_thousand_names_in_ten_seconds_are_decided_on_a_few_times_and_forgotten() -> None:
    """Of which nothing is said; that say a word, or how they are, and go; and one that is not on the bus."""
    plan = parse("roles: {scout: {mode: manual}}")
    hearing, memory, now = FleetObserver(), PolicyState(), 100.0
    come(hearing, "red", now)
    decisions = most = 0
    while now < 100.0 + 10.0 + FORGOTTEN_S + 2 * TURN_S:
        for number in range(100) if now < 110.0 else ():
            name = f"c{now:.1f}-{number}"
            if number < 99:
                hearing.token(name, now, alive=True)
            if number > 80:
                hearing.take(said("state/health", name), now, None)
            if number == 98:
                come(hearing, name, now)
            hearing.token(name, now, alive=False)
        hearing.forget(now, {*plan.named, *memory.held})
        result = step(plan, hearing.picture(()), memory, now)
        memory = result.memory
        decisions += len(result.changed) + len(result.reworded)
        most = max(most, len(result.decisions))
        now += TURN_S
    assert most <= MOST_GONE + 3
    assert decisions < 400, "one for each that said how it was (100 did), and what its role says of that"
    assert hearing.cars.keys() == hearing.readings.keys() == {"red"}
    assert memory.said.keys() == {"red", "role scout"}
    assert memory.gone_since.keys() <= {"red"}


@pytest.mark.parametrize("topic", NEEDED)
@pytest.mark.parametrize("sent", ["fleet.v1.Battery", "fleet.v1.Result", "foxglove.Log", "fleet.v1.Nothing"])
def test_another_message_than_the_topics_is_ignored(topic: str, sent: str) -> None:
    hearing = FleetObserver()
    hearing.token("red", 100.0, alive=True)
    hearing.take(Sample(f"fleet/red/{topic}", b"", messages.encoding_of(sent), 0, 1), 100.0, None)
    for each in NEEDED:
        hearing.take(said(each), 100.0, None)
    hearing.take(Sample(f"fleet/red/{topic}", b"", messages.encoding_of(sent), 0, 1), 101.0, None)
    assert set(hearing.readings["red"]) == set(NEEDED)
    assert hearing.unheard == set()


def test_a_token_that_names_no_car_is_ignored() -> None:
    hearing = FleetObserver()
    hearing.token("RED!", 100.0, alive=True)
    assert hearing.present == set()
