"""Names and key expressions."""

import pytest

from schemas import keys, topics


@pytest.mark.parametrize("name", ["red", "r", "0", "car-7_b", "a" * 32])
def test_allowed_names(name: str) -> None:
    assert keys.check_name(name) == name


@pytest.mark.parametrize("name", ["", "Red", "-red", "_red", "a" * 33, "red/blue", "röd", "red ", "*", "@red", "red\n"])
def test_refused_names_say_the_rule(name: str) -> None:
    with pytest.raises(keys.BadKey, match="use 1 to 32 of a-z"):
        keys.check_name(name)


@pytest.mark.parametrize(("name", "likely"), [("Red", "red"), ("my car", "my_car"), ("red ", "red")])
def test_refused_name_names_the_likely_one(name: str, likely: str) -> None:
    with pytest.raises(keys.BadKey, match=rf"digit\. Did you mean {likely}\?$"):
        keys.check_name(name)


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ("red", "fleet/red/sensor/*"),
        ("*", "fleet/*/sensor/*"),
        ("red/sensor/range", "fleet/red/sensor/range"),
        ("*/sensor/battery", "fleet/*/sensor/battery"),
        ("fleet/red/sensor/range", "fleet/red/sensor/range"),
        ("fleet/red", "fleet/red/sensor/*"),
        ("fleet", "fleet/*/sensor/*"),
        ("fleet/**", "fleet/**"),
        ("**", "fleet/**"),
        ("**/battery", "fleet/**/battery"),
        ("red/", "fleet/red/sensor/*"),
        ("re$*/state/*", "fleet/re$*/state/*"),
        ("@recorder/status", "fleet/@recorder/status"),
    ],
)
def test_short_forms(short: str, long: str) -> None:
    assert keys.expand(short) == long


@pytest.mark.parametrize("bad", ["", "/", "red//range", "re*", "**x", "red/sen sor", "red?x=1", "red#1"])
def test_bad_expressions_say_what_is_allowed(bad: str) -> None:
    with pytest.raises(keys.BadKey, match="is not a key"):
        keys.expand(bad)


def test_key_is_taken_apart_and_put_together() -> None:
    key = keys.parse("fleet/red/sensor/range")
    assert key == keys.Key("fleet", "red", "sensor/range")
    assert str(key) == "fleet/red/sensor/range"
    assert keys.parse("fleet") is None


def test_topic_of_a_key() -> None:
    assert topics.of_key("fleet/red/sensor/range") is topics.TOPICS["sensor/range"]
    assert topics.of_key("fleet/@recorder/status") is topics.TOPICS["@recorder/status"]
    assert topics.of_key("fleet/red/sensor/none") is None
    assert topics.of_key("fleet/red") is None


@pytest.mark.parametrize(
    ("sender", "name"),
    [
        ("ann@laptop-4711", "ann"),
        ("plan", "plan"),
        ("coordinator-ann@host-1", "coordinator-ann"),
        ("@x", "@x"),
        ("", ""),
    ],
)
def test_sender_is_called_by_its_name(sender: str, name: str) -> None:
    assert keys.name_of(sender) == name
