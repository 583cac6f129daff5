"""A session as one MCAP file with one schema per topic, read back with the MCAP reader."""

import json
from collections import Counter, defaultdict
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from fleet.cli import cli
from fleet.recording.reading.session import Session
from fleet.recording.tools.one_schema import OneSchema, write
from tests.fleet.recording.tools import every_type
from tests.support import random_session
from tests.support.random_session import LINK, RANGE, Mixed

Message = tuple[int, int, int, bytes]


def read(file: Path) -> tuple[dict[str, set[tuple[str, bytes]]], Counter[tuple[str, Message]]]:
    """Return the schemas of each topic, and all messages with their topics."""
    schemas: dict[str, set[tuple[str, bytes]]] = defaultdict(set)
    messages: Counter[tuple[str, Message]] = Counter()
    with file.open("rb") as stream:
        for schema, channel, each in make_reader(stream).iter_messages():
            schemas[channel.topic].add((schema.name, schema.data) if schema is not None else ("", b""))
            messages[channel.topic, (each.sequence, each.log_time, each.publish_time, each.data)] += 1
    return schemas, messages


def written(session: Session, out: Path) -> OneSchema:
    return write(session.rows(), session.extras(), out)


def test_stray_type_has_own_topic_even_if_first(tmp_path: Path) -> None:
    made = Mixed(tmp_path / "one.mcap")
    made.stray(LINK, RANGE)
    made.own(LINK, 25)
    made.put(LINK, "", b"{}", "json")
    made.own(RANGE, 3)
    made.close()
    done = written(Session(tmp_path / "one.mcap"), tmp_path / "out.mcap")
    schemas, messages = read(tmp_path / "out.mcap")
    assert Counter(topic for topic, _ in messages.elements()) == {
        LINK: 25,
        RANGE: 3,
        f"stray/{LINK}/fleet.v1.Range": 1,
        f"stray/{LINK}/json": 1,
    }
    assert [name for name, _ in schemas[LINK]] == ["fleet.v1.Link"]
    assert done.strays.by_key() == {LINK: 2}
    assert (done.fleet, done.cars) == ("fleet", ["red"])


def test_of_a_strangers_key_the_first_type_has_the_topic(tmp_path: Path) -> None:
    made = Mixed(tmp_path / "one.mcap")
    made.stray("imu/data", RANGE)
    made.stray("imu/data", LINK)
    made.close()
    done = written(Session(tmp_path / "one.mcap"), tmp_path / "out.mcap")
    assert set(read(tmp_path / "out.mcap")[0]) == {"imu/data", "stray/imu/data/fleet.v1.Link"}
    assert done.cars == []


@pytest.mark.parametrize("seed", range(60))
def test_every_message_is_there_under_one_schema(seed: int, tmp_path: Path) -> None:
    random_session.make(tmp_path / "one.mcap", seed)
    session = Session(tmp_path / "one.mcap")
    done = written(session, tmp_path / "out.mcap")
    schemas, messages = read(tmp_path / "out.mcap")
    assert max(map(len, schemas.values()), default=1) == 1
    assert done.messages == messages.total()
    assert Counter(message for _, message in messages.elements()) == Counter(row[1:] for row in session.rows())
    strays = Counter(topic.split("/", 1)[0] == "stray" for topic, _ in messages.elements())
    assert done.strays.total == strays[True]


def test_foxglove_export_writes_file_and_layout(tmp_path: Path) -> None:
    every_type.make(tmp_path / "one.mcap")
    arguments = ["sessions", "export", str(tmp_path / "one.mcap"), "--foxglove", str(tmp_path / "out")]
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == ["layout.json", "one.mcap"]
    topics = set(read(tmp_path / "out" / "one.mcap")[0])
    layout = json.loads((tmp_path / "out" / "layout.json").read_text(encoding="utf-8"))
    assert {topic for topic in topics if topic.endswith("/sensor/range")} <= {
        path["value"].rsplit(".", 1)[0] for panel in layout["configById"].values() for path in panel.get("paths", ())
    }
    assert CliRunner().invoke(cli, arguments).exit_code == 2, "it is there already"


def test_nothing_to_write_is_a_failure_that_leaves_nothing(tmp_path: Path) -> None:
    Mixed(tmp_path / "none.mcap").close()
    arguments = ["sessions", "export", str(tmp_path / "none.mcap"), "--foxglove", str(tmp_path / "out")]
    assert CliRunner().invoke(cli, arguments).exit_code == 1
    assert [each.name for each in tmp_path.iterdir()] == ["none.mcap"]
