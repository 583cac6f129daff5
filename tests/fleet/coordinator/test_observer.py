"""The coordinator's observations of cars, its pending queries, and the cars that it forgets."""

from math import inf

import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.coordinator.observer import FORGET_AFTER_S, MAX_ABSENT_CARS, REQUIRED_TOPICS, FleetObserver
from fleet.policy.decide import step
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import CarSnapshot
from fleet.policy.state import PolicyState
from schemas import messages, topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import NO_PEOPLE, People

TURN_S = 0.1


def said(topic: str, car: str = "red") -> Sample:
    name = topics.TOPICS[topic].message
    payload = messages.message_class(name)(car=car, seq=1).SerializeToString()
    return Sample(f"fleet/{car}/{topic}", payload, messages.encoding_of(name), 0, 1)


def come(observer: FleetObserver, car: str, now: float) -> None:
    observer.on_token(car, now, alive=True)
    for topic in REQUIRED_TOPICS:
        observer.on_sample(said(topic, car), now, None)


def test_car_is_unheard_until_all_denials_are_known() -> None:
    observer = FleetObserver()
    assert observer.unconfirmed == set()
    observer.on_token("red", 99.0, alive=True)
    for topic in REQUIRED_TOPICS:
        assert observer.unconfirmed == {"red"}
        observer.on_sample(said(topic), 100.0, None)
    assert observer.unconfirmed == set()
    observer.on_token("red", 101.0, alive=False)
    assert observer.unconfirmed == set(), "nobody could be asked"
    observer.on_token("red", 102.0, alive=True)
    assert observer.unconfirmed == {"red"}, "what was known of it may no longer be so"


def published(topic: str, message: object) -> Sample:
    name = topics.TOPICS[topic].message
    payload = message.SerializeToString()  # type: ignore[attr-defined]  # a message
    return Sample(f"fleet/red/{topic}", payload, messages.encoding_of(name), 0, 1)


def test_car_is_doubted_while_gateway_says_so() -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    assert not observer.cars["red"].doubted
    observer.on_sample(published("state/safety", pb.Safety(car="red", trust="unproven")), 101.0, None)
    assert not observer.cars["red"].doubted, "a car that never showed a stop is used like any other"
    observer.on_sample(published("state/safety", pb.Safety(car="red", trust="stopped")), 102.0, None)
    observer.on_sample(published("state/health", pb.Health(car="red", shows_stops="yes", doubted=True)), 103.0, None)
    assert observer.cars["red"].doubted, "it was driven since, and has still not shown a stop"
    observer.on_sample(published("state/health", pb.Health(car="red", shows_stops="no")), 104.0, None)
    assert not observer.cars["red"].doubted, "a car that cannot show its stops is used like any other"


def test_car_is_forgotten_a_minute_after_gateway_unless_named() -> None:
    observer = FleetObserver({"blue": CarSnapshot(listed=True)})
    for car in ("red", "green", "blue"):
        come(observer, car, 100.0)
        observer.on_token(car, 101.0, alive=False)
    observer.forget(101.0 + FORGET_AFTER_S - 0.1, {"green"})
    assert observer.snapshot(()).cars.keys() == {"red", "green", "blue"}
    observer.forget(101.0 + FORGET_AFTER_S, {"green"})
    assert observer.snapshot(()).cars.keys() == observer.snapshot(()).readings.keys() == {"green", "blue"}
    observer.on_token("green", 200.0, alive=True)
    observer.forget(1000.0, ())
    assert observer.present == {"green"}


def test_car_back_within_a_minute_is_not_forgotten() -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    observer.on_token("red", 101.0, alive=False)
    come(observer, "red", 150.0)
    observer.forget(300.0, ())
    assert observer.present == {"red"}


def test_ten_thousand_names_are_decided_rarely_and_forgotten() -> None:
    """Most names have only a token, some also a state, and one is not on the bus. All of them disappear."""
    plan = parse("roles: {scout: {mode: manual}}")
    observer, memory, now = FleetObserver(), PolicyState(), 100.0
    come(observer, "red", now)
    decisions = most = 0
    while now < 100.0 + 10.0 + FORGET_AFTER_S + 2 * TURN_S:
        for number in range(100) if now < 110.0 else ():
            name = f"c{now:.1f}-{number}"
            if number < 99:
                observer.on_token(name, now, alive=True)
            if number > 80:
                observer.on_sample(said("state/health", name), now, None)
            if number == 98:
                come(observer, name, now)
            observer.on_token(name, now, alive=False)
        observer.forget(now, {*plan.named_cars, *memory.held_roles})
        result = step(plan, observer.snapshot(()), memory, now)
        memory = result.memory
        decisions += len(result.changed) + len(result.reworded)
        most = max(most, len(result.decisions))
        now += TURN_S
    assert most <= MAX_ABSENT_CARS + 3
    assert decisions < 400, "one for each that said how it was (100 did), and what its role says of that"
    assert observer.cars.keys() == observer.states.keys() == {"red"}
    assert memory.decisions.keys() == {"red", "role scout"}
    assert memory.gone_since.keys() <= {"red"}


@pytest.mark.parametrize("topic", REQUIRED_TOPICS)
@pytest.mark.parametrize("sent", ["fleet.v1.Battery", "fleet.v1.Result", "foxglove.Log", "fleet.v1.Nothing"])
def test_observer_ignores_message_of_wrong_type(topic: str, sent: str) -> None:
    observer = FleetObserver()
    observer.on_token("red", 100.0, alive=True)
    observer.on_sample(Sample(f"fleet/red/{topic}", b"", messages.encoding_of(sent), 0, 1), 100.0, None)
    for each in REQUIRED_TOPICS:
        observer.on_sample(said(each), 100.0, None)
    observer.on_sample(Sample(f"fleet/red/{topic}", b"", messages.encoding_of(sent), 0, 1), 101.0, None)
    assert set(observer.states["red"].newest_by_topic) == set(REQUIRED_TOPICS)
    assert observer.unconfirmed == set()


def test_people_are_those_that_any_gateway_knows() -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    assert observer.people == NO_PEOPLE
    observer.on_token("blue", 100.0, alive=True)
    people = pb.CarPeople(leads=["teacher"], drivers=["ann"], others=["bob"])
    safety = pb.Safety(car="blue", seq=1, people=people).SerializeToString()
    observer.on_sample(
        Sample("fleet/blue/state/safety", safety, messages.encoding_of("fleet.v1.Safety"), 0, 1), 101.0, None
    )
    assert observer.people == People.parse(["teacher:lead", "ann", "bob:other"])
    observer.on_token("blue", 102.0, alive=False)
    assert observer.people == NO_PEOPLE


def test_late_hold_of_earlier_gateway_blocks_nobody() -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    held = pb.Safety(car="red", boot_id="a", hold=pb.Hold(by="ann"))
    observer.on_sample(published("state/safety", held), 101.0, None)
    assert observer.cars["red"].held_by == "ann"
    for topic in REQUIRED_TOPICS:
        message = messages.message_class(topics.TOPICS[topic].message)(car="red", boot_id="b")
        observer.on_sample(published(topic, message), 102.0, None)
    assert observer.cars["red"].held_by is None
    observer.on_sample(published("state/safety", held), 102.1, None)
    assert observer.cars["red"].held_by is None, "the gateway that said so has ended"
    come(observer, "red", 103.0)
    observer.on_sample(published("state/safety", held), 103.0, None)
    assert observer.cars["red"].held_by == "ann", "a recording is played again"


@pytest.mark.parametrize(
    ("motion", "safety", "driver", "taken"),
    [
        (pb.Motion(owner="mia"), pb.Safety(lease=pb.Lease(holder="jo", kind="person")), "mia", None),
        (pb.Motion(), pb.Safety(lease=pb.Lease(holder="jo", kind="person")), "jo", None),
        (pb.Motion(), pb.Safety(lease=pb.Lease(holder="@coordinator", kind="coordinator")), None, None),
        (pb.Motion(), pb.Safety(loan=pb.Loan(to="bob", by="ann")), None, "bob"),
        (pb.Motion(), pb.Safety(pauses=[pb.Pause(by="ann")]), None, "ann"),
    ],
)
def test_observer_knows_who_drives_or_holds_car(
    motion: pb.Motion, safety: pb.Safety, driver: str | None, taken: str | None
) -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    observer.on_sample(published("state/motion", motion), 101.0, None)
    observer.on_sample(published("state/safety", safety), 101.0, None)
    assert (observer.cars["red"].driven_by, observer.cars["red"].taken_by) == (driver, taken)


def test_message_may_come_before_token() -> None:
    observer = FleetObserver()
    observer.on_sample(said("sensor/range"), 100.0, None)
    come(observer, "red", 101.0)
    observer.on_sample(published("state/mode", pb.Mode(car="red", asked="tracking")), 102.0, None)
    assert observer.cars["red"].mode == "tracking"


def test_answer_with_stamp_far_ahead_is_stale() -> None:
    observer = FleetObserver()
    for ahead_s, at in ((9.0, 100.0), (11.0, -inf)):
        message = pb.Range(car="red", stamp=Timestamp(seconds=int(1e9 + ahead_s)))
        observer.states.clear()
        observer.on_sample(published("sensor/range", message), 100.0, 1e9)
        assert observer.states["red"].newest_by_topic["sensor/range"].at == at


def test_token_of_invalid_name_is_ignored() -> None:
    observer = FleetObserver()
    observer.on_token("RED!", 100.0, alive=True)
    assert observer.present == set()


def test_after_computer_sleep_no_old_reading_is_fresh() -> None:
    observer = FleetObserver()
    come(observer, "red", 100.0)
    observer.on_sample(said("sensor/range"), 100.0, None)
    observer.on_sleep(3600.0)
    ages = {100.0 - reading.at for reading in observer.snapshot(()).readings["red"].values()}
    assert ages == {3600.0}
    assert observer.present == {"red"}
    observer.on_sample(said("sensor/range"), 100.2, None)
    assert observer.snapshot(()).readings["red"]["sensor/range"].at == 100.2
