"""What is published of cars for Home Assistant, by their newest messages. tests/soak/test_mqtt.py has a real broker."""

import json
from collections.abc import Iterable
from typing import Any

from fleet.bridges.home_assistant import ENTITIES, EXPIRE_S, MAX_ANNOUNCED_CARS, REPEAT_S, HomeAssistant, Publication
from fleet.client.car_state import CarState
from schemas.gen import fleet_v1_pb2 as pb

RED = "car-fleet/fleet/red"
CONFIG = "homeassistant/device/car-fleet_fleet_red/config"


def car(name: str = "red", at: float = 0.0, link: str = "online", **messages: Any) -> CarState:
    state = CarState(name)
    state.take("state/link", pb.Link(state=link, boot_id="1"), at)
    for topic, message in messages.items():
        state.take(topic.replace("_", "/"), message, at)
    return state


def by_topic(publications: Iterable[Publication]) -> dict[str, str]:
    return {each.topic: each.payload for each in publications}


def values(publications: Iterable[Publication]) -> Any:
    return json.loads(by_topic(publications)[f"{RED}/state"])


def test_car_is_announced_once_with_entity_for_each_value() -> None:
    plan = HomeAssistant("fleet")
    first = list(plan.news({"red": car()}, 0.0))
    assert [(each.topic, each.retain) for each in first] == [
        (f"{RED}/availability", True),
        (CONFIG, True),
        (f"{RED}/state", False),
    ]
    config = json.loads(first[1].payload)
    components = config["components"]
    assert set(components) == {each.name for each in ENTITIES} == set(values(first))
    assert len({each["unique_id"] for each in components.values()}) == len(components)
    assert config["state_topic"] == f"{RED}/state"
    for name, each in components.items():
        assert f"value_json.{name}" in each["value_template"]
        assert "command_topic" not in each
        topics = [one["topic"] for one in each["availability"]]
        assert topics[0] == plan.bridge_availability
        assert topics[1:] == ([] if name == "connected" else [f"{RED}/availability"])
    assert components["mode"]["options"][-1] == "unknown"
    assert "'unknown'" in components["mode"]["value_template"]
    assert list(plan.news({"red": car()}, 0.5)) == []


def test_car_is_connected_while_its_silence_is_expected() -> None:
    """A car that sends nothing in its mode was shown as disconnected, and as moving."""
    found = {link: values(HomeAssistant("fleet").news({"red": car(link=link)}, 0.0)) for link in ("quiet", "stale")}
    assert {link: each["connected"] for link, each in found.items()} == {"quiet": True, "stale": False}


def test_only_what_was_measured_has_a_value() -> None:
    plan = HomeAssistant("fleet")
    assert values(plan.news({"red": car()}, 0.0)) == {each.name: None for each in ENTITIES} | {"connected": True}
    measured = car(
        sensor_battery=pb.Battery(voltage_v=7.4123, level="low"),
        sensor_range=pb.Range(no_echo=True),
        state_mode=pb.Mode(asked="tracking", inferred="unknown", boot_id="1"),
        state_safety=pb.Safety(motors="stopping", estops=[pb.Estop()], boot_id="1"),
    )
    assert values(plan.news({"red": measured}, 1.0)) == {
        "connected": True,
        "battery_v": 7.412,
        "battery_level": "low",
        "distance_m": None,
        "mode": "tracking",
        "mode_inferred": None,
        "moving": None,
        "estopped": True,
    }
    odd = car(state_mode=pb.Mode(asked="\x1b[31m{{ 1 }}", boot_id="1"), sensor_range=pb.Range(range_m=1.0))
    found = values(plan.news({"red": odd}, 2.0))
    assert (found["mode"], found["distance_m"]) == (None, 1.0)
    # Readings that are stale are no values, even while the gateway speaks.
    odd.take("state/link", pb.Link(state="online", boot_id="1"), 9.0)
    assert values(plan.news({"red": odd}, 9.0))["distance_m"] is None


def test_car_that_is_lost_silent_or_gone_is_offline() -> None:
    plan = HomeAssistant("fleet")
    red = car()
    plan_topics = f"{RED}/availability"
    assert by_topic(plan.news({"red": red}, 0.0))[plan_topics] == "online"
    steps: list[tuple[dict[str, CarState], float, str]] = [
        ({"red": car(at=1.0, link="lost")}, 1.0, "offline"),
        ({"red": car(at=2.0)}, 2.0, "online"),
        ({"red": car(at=2.0)}, 20.0, "offline"),  # its gateway hangs
        ({"red": car(at=21.0)}, 21.0, "online"),
        ({}, 22.0, "offline"),  # forgotten
        ({"red": car(at=23.0, link="stale")}, 23.0, "online"),
    ]
    for states, now, said in steps:
        found = by_topic(plan.news(states, now))
        assert found[plan_topics] == said, now
        if said == "offline" and states:
            assert json.loads(found[f"{RED}/state"]) == {each.name: None for each in ENTITIES} | {"connected": False}
        assert CONFIG not in found, "announced again"


def test_state_is_repeated_before_expiry_at_most_once_a_second() -> None:
    assert REPEAT_S < EXPIRE_S
    plan = HomeAssistant("fleet")
    count = 0
    for tenth in range(600):
        now = tenth / 10
        red = car(at=now, sensor_range=pb.Range(range_m=now if now < 30 else 30.0))
        count += f"{RED}/state" in by_topic(plan.news({"red": red}, now))
    assert count == 30 + 1 + 2


def test_availability_left_by_killed_bridge_is_set_offline() -> None:
    plan = HomeAssistant("fleet")
    assert list(plan.adopt(f"{RED}/availability", b"online")) == [Publication(f"{RED}/availability", "offline", True)]
    assert list(plan.adopt(f"{RED}/availability", b"offline")) == []
    for topic in (plan.bridge_availability, "car-fleet/fleet/No Name/availability", "car-fleet/availability", "x"):
        assert list(plan.adopt(topic, b"online")) == []
    list(plan.news({"green": car("green")}, 0.0))
    assert list(plan.adopt("car-fleet/fleet/green/availability", b"online")) == []
    removed = list(plan.end())
    assert all(each == Publication(each.topic, "", True) for each in removed)
    assert {each.topic for each in removed} == {
        CONFIG,
        CONFIG.replace("red", "green"),
        f"{RED}/availability",
        f"{RED}/availability".replace("red", "green"),
        plan.bridge_availability,
    }


def test_everything_is_published_again_to_a_restarted_broker() -> None:
    plan = HomeAssistant("fleet")
    states = {"red": car()}
    first = by_topic(plan.news(states, 0.0))
    again = by_topic([*plan.begin(), *plan.news(states, 0.1)])
    assert again == first | {plan.bridge_availability: "online"}


def test_invented_names_are_bounded_and_displace_no_present_car() -> None:
    plan = HomeAssistant("fleet")
    for number in range(2 * MAX_ANNOUNCED_CARS):
        list(plan.adopt(f"car-fleet/fleet/x{number}/availability", b"online"))
    assert len([each for each in plan.end() if each.topic.endswith("/config")]) == MAX_ANNOUNCED_CARS
    for number in range(MAX_ANNOUNCED_CARS):
        list(plan.adopt(f"car-fleet/fleet/x{number}/availability", b"online"))
    found = list(plan.news({"red": car()}, 0.0))
    assert found[0] == Publication("homeassistant/device/car-fleet_fleet_x0/config", "", True)
    assert by_topic(found)[f"{RED}/availability"] == "online"
    there = {f"y{number:03}": car(f"y{number:03}") for number in range(2 * MAX_ANNOUNCED_CARS)}
    list(plan.news({"red": car(), **there}, 1.0))
    online = [each for each in plan.begin() if each.payload == "online"]
    assert len(online) == MAX_ANNOUNCED_CARS + 1
    assert f"{RED}/availability" in [each.topic for each in online]
