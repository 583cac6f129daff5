"""The layout for Foxglove: every panel has an existing key and field, and every key has a panel."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fleet.replay import foxglove_layout
from schemas.messages import message_class
from schemas.topics import TOPICS, of_key

FILE = Path(__file__).parents[3] / "deploy" / "foxglove.json"
PATH = re.compile(r'(?:"(?P<quoted>[^"]+)"|(?P<plain>[A-Za-z0-9_/]+))(?P<fields>(?:\.[a-z_]+(?:\[\d\])?)*)')
"""The part of Foxglove's grammar of message paths that we use."""


def test_file_is_what_the_tables_make() -> None:
    command = "python -m fleet.replay.foxglove_layout > deploy/foxglove.json"
    assert json.loads(FILE.read_text()) == foxglove_layout.layout(), command


def test_layout_paths_are_fields_and_every_topic_is_shown() -> None:
    layout = json.loads(FILE.read_text())
    shown = set()
    for kind, config in ((name.partition("!")[0], each) for name, each in layout["configById"].items()):
        for path in _paths(kind, config):
            match = PATH.fullmatch(path)
            assert match, path
            topic = of_key(match["quoted"] or match["plain"])
            assert topic is not None, path
            shown.add(topic.name)
            descriptor: Any = message_class(topic.message).DESCRIPTOR
            for field in re.findall(r"[a-z_]+", match["fields"]):
                assert field in descriptor.fields_by_name, path
                descriptor = descriptor.fields_by_name[field].message_type
            assert descriptor is None or kind in ("RawMessages", "RosOut"), path
        if kind == "RosOut":
            topic = of_key(config["topicToRender"])
            assert topic is not None
            assert topic.message == foxglove_layout.LOG
    assert shown == set(TOPICS)


def _paths(kind: str, config: dict[str, Any]) -> Iterator[str]:
    if kind in ("Plot", "StateTransitions"):
        yield from (path["value"] for path in config["paths"])
    elif kind == "RawMessages":
        yield config["topicPath"]
    elif kind == "RosOut":
        yield json.dumps(config["topicToRender"])
    else:
        assert kind == "Tab"


def test_every_panel_has_its_place() -> None:
    layout = foxglove_layout.layout(("red", "car-2"))
    placed = list(_places(layout["layout"], layout["configById"]))
    assert sorted(placed) == sorted(layout["configById"])
    (root,) = (each for name, each in layout["configById"].items() if name.startswith("Tab!"))
    assert [tab["title"] for tab in root["tabs"]] == ["Fleet", "red", "car-2", "Services"]
    assert '"fleet/car-2/sensor/range".range_m' in json.dumps(layout).replace("\\", "")


def _places(at: Any, panels: dict[str, Any]) -> Iterator[str]:
    if isinstance(at, dict):
        assert 0 < at["splitPercentage"] < 100
        assert at["direction"] in ("row", "column")
        yield from _places(at["first"], panels)
        yield from _places(at["second"], panels)
        return
    yield at
    for tab in panels[at].get("tabs", ()):
        yield from _places(tab["layout"], panels)
