"""Messages of pages: the console checks each value, and rejects invalid ones."""

import contextlib
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.console.page_requests import BadPageMessage, PageMessage


def message(**fields: Any) -> PageMessage:
    return PageMessage.of(json.dumps(fields))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "1", '"drive"', "[" * 100_000, '{"t": 1}', '{"t": "' + "x" * 20 + '"}', r'{"t": "\ud800"}']
)
def test_malformed_page_message_is_refused(text: str) -> None:
    with pytest.raises(BadPageMessage):
        _ = PageMessage.of(text).kind


@pytest.mark.parametrize(
    "fields",
    [
        {"verb": "drive", "motion": "forward"},  # only presses drive
        {"verb": "lease"},
        {"verb": "mode", "mode": "flying"},
        {"verb": "mode"},
        {"verb": "led", "rgb": [1, 2]},
        {"verb": "led", "rgb": [1, 2, 256]},
        {"verb": "led", "rgb": [1, 2, True]},
        {"verb": "led", "rgb": [1, 2, 0.5]},
        {"verb": "led", "rgb": [1, 2, -1]},
        {"verb": "servo", "deg": 181},
        {"verb": "servo", "servo": "front", "action": "sideways"},
        {"verb": "arm", "joint_deg": [90] * 5},
        {"verb": "arm", "joint_deg": [90] * 5 + [1e99]},
        {"verb": "speed", "step": "warp"},
        {"verb": "resume", "ids": "all"},
        {"verb": "resume", "ids": [1]},
    ],
)
def test_bad_command_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(BadPageMessage):
        message(**fields).request()


@pytest.mark.parametrize("names", [None, [], "red", ["red/../blue"], ["*"], ["@coordinator"], ["red"] * 129, [1, {}]])
def test_bad_cars_are_refused(names: Any) -> None:
    with pytest.raises(BadPageMessage):
        message(cars=names).cars()


def test_wrong_details_make_no_stop_fail() -> None:
    assert message(verb="estop", why="x" * 201).request().message.why == "x" * 200
    assert message(verb="estop", why="half \ud83d").request().message.why == "half  "
    assert message(verb="estop", why=["x"]).request().message.why == ""
    assert message(id="x" * 65).text_if_valid("id") == message(id=5).text_if_valid("id") == ""
    assert message(cars=["red", "Not a car", 1, "red", "blue"]).stopped_cars() == ("red", "blue")
    for cars in (None, [], ["*"], [1, {}]):
        with pytest.raises(BadPageMessage):
            message(cars=cars).stopped_cars()


def test_good_command_becomes_its_request() -> None:
    assert message(verb="led", rgb=[1, 2, 3]).request().message.g == 2
    assert message(verb="servo", deg=30).request().message.deg == 30
    assert message(verb="mode", mode="tracking", take=True).request().take
    assert list(message(verb="resume", ids=["e1"]).request().message.ids) == ["e1"]
    assert message(cars=["red", "blue", "red"]).cars() == ("red", "blue")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
)
VERBS = ("mode", "led", "light", "servo", "arm", "resume", "speed", "estop", "fan")
FIELDS = ("rgb", "deg", "mode", "light", "servo", "action", "joint_deg", "ids", "step", "why", "take")


@given(st.sampled_from(VERBS), st.dictionaries(st.sampled_from(FIELDS), JSON))
def test_any_values_are_a_request_or_refused(verb: str, fields: dict[str, Any]) -> None:
    with contextlib.suppress(BadPageMessage):
        message(verb=verb, **fields).request()
