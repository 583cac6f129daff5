"""What is decided, as a table of pictures; nothing of it depends on a clock."""

from dataclasses import replace
from typing import Any

import pytest

from fleet.policy.decide import CarPicture, Decision, Picture, Seen, decide
from fleet.policy.plan import parse
from gateway.protocol.values import Mode

PLAN = parse("""
cars: {red: tracking, blue: manual}
rules:
  - when: {car: red, reading: sensor/range, field: range_m, below: 0.3, for_s: 1}
    then: {car: blue, mode: obstacle_avoidance}
  - when: {car: red, reading: sensor/battery, field: level, equals: critical}
    then: {car: blue, mode: color_led}
""")
HERE = CarPicture(present=True, mode="manual", verdict="confirmed", link="online")


def seen(at: float, **fields: Any) -> Seen:
    return Seen(fields, at)


def decided(picture: Picture, *, since: dict[int, float] | None = None, now: float = 10.0) -> dict[str, Decision]:
    return {each.car: each for each in decide(PLAN, picture, since or {}, now).decisions}


@pytest.mark.parametrize(
    ("car", "mode", "ask"),
    [
        (HERE, Mode.TRACKING, True),
        (replace(HERE, mode="tracking"), Mode.TRACKING, False),
        (replace(HERE, mode="tracking", verdict="assumed"), Mode.TRACKING, False),
        (replace(HERE, mode="tracking", verdict="contradicted"), Mode.TRACKING, True),
        (replace(HERE, mode="unknown"), Mode.TRACKING, True),
        (CarPicture(), None, False),
        (CarPicture(present=True), None, False),
        (replace(HERE, held_by="ann"), None, False),
        (replace(HERE, estopped_by="ann"), None, False),
        (replace(HERE, mode="tracking", verdict="contradicted", held_by="ann"), None, False),
        (replace(HERE, driven_by="ann"), None, False),
        (replace(HERE, present=False), None, False),
        (replace(HERE, link="lost"), None, False),
        (replace(HERE, mode="unknown", link="lost"), None, False),
        (replace(HERE, link="stale"), Mode.TRACKING, True),
    ],
)
def test_a_car_is_brought_to_its_mode_or_left_alone(car: CarPicture, mode: Mode | None, ask: bool) -> None:
    decision = decided(Picture({"red": car, "blue": HERE}))["red"]
    assert (decision.mode, decision.ask) == (mode, ask)


def test_who_holds_it_is_said_and_what_ends_it() -> None:
    decision = decided(Picture({"red": replace(HERE, held_by="ann")}))["red"]
    assert decision.why == "red is on hold by ann"
    assert decision.would_change == "a drive, mode or resume by a person or script"


@pytest.mark.parametrize(
    ("reading", "since", "mode"),
    [
        (seen(9.9, range_m=0.2), {0: 9.0}, Mode.OBSTACLE_AVOIDANCE),
        (seen(9.9, range_m=0.2), {0: 9.1}, Mode.MANUAL),  # not for long enough
        (seen(9.9, range_m=0.2), {}, Mode.MANUAL),  # it has only begun
        (seen(9.9, range_m=0.3), {0: 1.0}, Mode.MANUAL),  # below is not at
        (seen(9.9, no_echo=True), {0: 1.0}, Mode.MANUAL),  # not measured
        (seen(6.9, range_m=0.2), {0: 1.0}, Mode.MANUAL),  # older than a range may be
        (seen(7.1, range_m=0.2), {0: 1.0}, Mode.OBSTACLE_AVOIDANCE),
    ],
)
def test_a_rule_counts_while_its_reading_is_measured_fresh_and_lasting(
    reading: Seen, since: dict[int, float], mode: Mode
) -> None:
    picture = Picture({"red": HERE, "blue": HERE}, {("red", "sensor/range"): reading})
    assert decided(picture, since=since)["blue"].mode is mode


def test_time_is_counted_from_when_it_began_and_anew_after_a_break() -> None:
    near = Picture({"blue": HERE}, {("red", "sensor/range"): seen(10.0, range_m=0.1)})
    far = Picture({"blue": HERE}, {("red", "sensor/range"): seen(10.0, range_m=2.0)})
    first = decide(PLAN, near, {}, 10.0)
    assert first.since == {0: 10.0}
    assert decide(PLAN, near, first.since, 11.0).decisions[1].mode is Mode.OBSTACLE_AVOIDANCE
    assert decide(PLAN, far, first.since, 10.5).since == {}


def test_the_first_rule_that_is_true_counts_and_says_what_it_used() -> None:
    readings = {
        ("red", "sensor/range"): seen(10.0, range_m=0.1234567),
        ("red", "sensor/battery"): seen(10.0, level="critical"),
    }
    picture = Picture({"red": HERE, "blue": HERE}, readings)
    decision = decided(picture, since={0: 1.0})["blue"]
    assert (decision.cause, decision.mode) == ("rule 1", Mode.OBSTACLE_AVOIDANCE)
    assert decision.readings == ("red/sensor/range range_m=0.1235",)
    assert decided(picture)["blue"].cause == "rule 2"
    assert decided(picture)["red"].cause == "plan"


def test_the_same_picture_gives_the_same_decisions() -> None:
    picture = Picture({"red": HERE}, {("red", "sensor/range"): seen(10.0, range_m=0.1)})
    assert decide(PLAN, picture, {}, 10.0) == decide(PLAN, picture, {}, 10.0)
