"""`fleet find`: the runs of a condition, as `fleet wait --for` sees them live, and the command over all sessions."""

import csv
import io
import json
import random
import shlex
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterable
from copy import deepcopy
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import rerun.chunk as rrc
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.writer import Writer
from msgspec.structs import replace

from fleet.client.condition import KeyCondition
from fleet.client.reading import Reading
from fleet.client.wait import ConditionWait
from fleet.conditions import BadExpression
from fleet.console import DEFAULT_PORT
from fleet.fleetfile.fleet_file import PinRule
from fleet.policy.car_condition import parse_condition
from fleet.recording.reading.session import Session
from fleet.recording.session_dir import SESSION_FILE
from fleet.recording.tools.condition_search import ConditionRun, find_in
from fleet.recording.tools.summary import overview
from fleet.recording.writing.pin_watch import PinWatch
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.fleet.replay.make_session import START_NS, Made
from tests.support import in_process
from tests.support.soaks import only_in_soak

S = 1_000_000_000
NEAR = "range_m < 0.3"


MESSAGES: dict[str, Any] = {"range": pb.Range, "light": pb.Light}


def spans(condition: str, rows: Iterable[tuple[float, str, dict[str, Any]]], for_s: float = 0.0) -> list[Any]:
    run = ConditionRun(parse_condition(condition), "red", for_s)
    for at_s, topic, fields in rows:
        run.add(f"sensor/{topic}", MESSAGES[topic](**fields), round(at_s * S))
    return [(hit.begin_ns / S, hit.end_ns / S) for hit in run.close()]


def distances(*rows: tuple[float, float | None]) -> list[tuple[float, str, dict[str, Any]]]:
    return [(at_s, "range", {} if value is None else {"range_m": value}) for at_s, value in rows]


def test_hit_lasts_from_its_first_reading_to_its_last() -> None:
    rows = distances((0, 1.0), (1, 0.2), (2, 0.1), (3, 1.0), (4, 0.2), (5, 1.0))
    assert spans(NEAR, rows) == [(1, 2), (4, 4)]
    assert spans(NEAR, rows, for_s=1.0) == [(1, 2)]
    assert spans(NEAR, rows, for_s=1.1) == []


def test_neither_a_gap_nor_what_was_not_measured_is_true() -> None:
    assert spans(NEAR, distances((0, 0.2), (1, 0.2), (4.5, 0.2), (5, 0.2))) == [(0, 1), (4.5, 5)]
    assert spans(NEAR, distances((0, 0.2), (3, 0.2))) == [(0, 3)], "at its limit a value is not stale"
    assert spans(NEAR, distances((0, 0.2), (1, None), (2, 0.2))) == [(0, 0), (2, 2)]
    assert spans("not range_m < 0.3", distances((0, None), (1, 0.5), (2, None))) == [(1, 1)]


def test_one_known_part_decides_until_it_is_stale() -> None:
    rows: list[tuple[float, str, dict[str, Any]]] = [
        (0.0, "light", {"left": True}),
        (1.0, "range", {}),
        (2.0, "range", {}),
        (4.0, "range", {}),
        (5.0, "light", {"left": True}),
        (6.0, "range", {"range_m": 1.0}),
    ]
    assert spans("light.left or range_m < 0.3", rows) == [(0, 2), (5, 6)]
    assert spans("light.left and range_m > 0.3", rows) == [(6, 6)]
    at_its_limit: list[tuple[float, str, dict[str, Any]]] = [rows[0], (3.0, "range", {"range_m": 1.0})]
    assert spans("light.left and range_m > 0.3", at_its_limit) == [(3, 3)]


@pytest.mark.parametrize("seed", [*range(40), *only_in_soak(range(40, 200))])
def test_find_hits_when_wait_would_end(seed: int) -> None:
    """Each prefix of random readings with gaps has a hit exactly if `fleet wait --for` would have ended in it."""
    rng = random.Random(seed)
    for_s = rng.choice([0.0, 0.5, 2.0, 5.0])
    run, ended = ConditionRun(parse_condition(NEAR), "red", for_s), False
    wait = ConditionWait(KeyCondition.of(NEAR, "fleet/red/sensor/range"), for_s)
    at_ns = START_NS
    near_ns: int | None = None
    expected = False
    for _ in range(40):
        before_ns = at_ns
        at_ns += rng.choice([100, 500, 1000, 1000, 1000, 2900, 3000, 3100, 9000]) * 1_000_000
        value = rng.choice([0.1, 0.1, 0.1, 0.1, 0.5, None])
        message = pb.Range(no_echo=True) if value is None else pb.Range(range_m=value)
        message.stamp.FromNanoseconds(at_ns)
        reading = Reading.of("fleet/red/sensor/range", message, at_ns)
        ended = wait.ends(reading, reading.time, at_ns / S) or ended
        run.add("sensor/range", message, at_ns)
        hits = deepcopy(run).close()
        # Both feed one evaluator: this is what it must say, in other words.
        if value != 0.1:
            near_ns = None
        elif near_ns is None or at_ns - before_ns > 3 * S:
            near_ns = at_ns
        expected = expected or (near_ns is not None and at_ns - near_ns >= for_s * S)
        assert bool(hits) == ended == expected


TOPIC_OF = {pb.Range: "sensor/range", pb.Light: "sensor/light", pb.Mode: "state/mode"}
CONDITIONS = (
    NEAR,
    f"not {NEAR}",
    f"light.left and {NEAR}",
    f"light.left or not {NEAR}",
    "rate(range_m) < -0.1",
    f"mode.asked == 'tracking' and {NEAR}",
)


@pytest.mark.parametrize("seed", [*range(40), *only_in_soak(range(40, 200))])
def test_live_and_from_disk_the_hits_are_the_same(seed: int, tmp_path: Path) -> None:
    """A session with gaps, restarts, drops and a clock that is set back, seen by who listened, and found in its file.

    What the recorder dropped for a while is in the file later than its number. What it dropped forever nobody saw.
    """
    rng = random.Random(seed)
    expression = parse_condition(rng.choice(CONDITIONS))
    for_s = rng.choice([0.0, 0.5, 2.0])
    live, pins = ConditionRun(expression, "red", for_s), PinWatch([PinRule(expression, 0, 0)])
    made = Made(tmp_path / "made.mcap", Writer)
    waiting: list[tuple[str, Any, int, int]] = []
    numbers: Counter[str] = Counter()
    pinned: dict[int, int] = {}
    clock: dict[int, int] = {}
    """The recorder's time of each stamp."""
    boot, at_ns, log_ns = 1, START_NS, START_NS
    for _ in range(rng.choice([60, 200])):
        passed_ns = rng.choice([20, 100, 100, 500, 1000, 3000, 9000]) * 1_000_000
        at_ns, log_ns = at_ns + passed_ns, log_ns + passed_ns
        if not waiting and rng.random() < 0.02:  # the gateway starts again
            boot, numbers = boot + 1, Counter()
        if not waiting and rng.random() < 0.01:  # somebody sets the clock of its computer back
            at_ns -= rng.randrange(300, 4000) * S
        now: list[Any] = [
            rng.choice([pb.Range(range_m=0.1), pb.Range(range_m=0.5), pb.Range(no_echo=True)]),
            pb.Light(left=rng.random() < 0.7),
        ]
        if passed_ns >= S or len(numbers) < 3:  # gateways repeat states each second
            now.append(pb.Mode(asked=rng.choice(["tracking", "tracking", "manual"])))
        for message in now:
            at_ns, log_ns = at_ns + 1_000_000, log_ns + 1_000_000
            topic = TOPIC_OF[type(message)]
            key = f"fleet/red/{topic}"
            numbers[key] += 1
            if rng.random() < 0.05:
                continue  # nobody got it
            message.stamp.FromNanoseconds(at_ns)
            message.car, message.seq, message.boot_id = "red", numbers[key], f"boot-{boot}"
            clock[at_ns] = log_ns
            live.add(topic, message, at_ns)
            encoding = messages.encoding_of(message.DESCRIPTOR.full_name)
            for pin in pins.add(key, encoding, message.SerializeToString(), at_ns, at_ns):
                pinned[pin.begin_ns] = pin.end_ns
            waiting.append((key, message, at_ns, log_ns))
        if rng.random() < 0.9:  # else the recorder is away, and asks for it later
            for key, message, stamp_ns, own_ns in sorted(waiting, key=lambda each: each[2] < at_ns - 5_000_000):
                made.put_as_is(key, message, stamp_ns, log_ns if stamp_ns < at_ns - 5_000_000 else own_ns)
            waiting.clear()
    for key, message, stamp_ns, _ in waiting:
        made.put_as_is(key, message, stamp_ns, log_ns)
    made.close()
    hits = live.close()
    # A recording has the recorder's clock, which nobody sets here.
    on_its_clock = [replace(hit, begin_ns=clock[hit.begin_ns], end_ns=clock[hit.end_ns]) for hit in hits]
    found = find_in(Session(tmp_path / "made.mcap"), expression, ["red"], for_s)
    assert found.hits == sorted(on_its_clock, key=lambda hit: hit.begin_ns)
    assert found.left_out.total == 0
    if not for_s:
        assert {hit.begin_ns: hit.end_ns for hit in hits} == pinned


@pytest.mark.parametrize("text", ["rang_m < 1", "range_m <", "range_m < 'a'", "left", "range_m < 0"])
def test_bad_condition_is_refused_before_anything_is_read(text: str) -> None:
    with pytest.raises(BadExpression):
        parse_condition(text)
    assert in_process.fleet("find", text, "/").returncode == 2


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    """Make a session: red is near from 3 to 5 s, in mode tracking, after a drive by mia. Blue is never near."""
    path = tmp_path / "all" / "s 1"
    path.mkdir(parents=True)
    made = Made(path / "0001.mcap", Writer)
    for second in (0, 1, 2, 5, 6, 7, 3, 4, 8):  # 3 and 4 were backfilled
        made.put("fleet/red/sensor/range", pb.Range(range_m=0.2 if 3 <= second <= 5 else 1.0), second)
        made.put("fleet/blue/sensor/range", pb.Range(range_m=2.0), second)
        made.put("fleet/red/state/mode", pb.Mode(asked="tracking" if second >= 2 else "manual"), second)
    for verb, phase, at_s in (("drive", "sent", 1.5), ("led", "asked", 2.0), ("stop", "sent", 6.0)):
        made.put("fleet/red/event/command", pb.CommandEvent(verb=verb, phase=phase, sender="mia@host-1"), at_s)
    made.close()
    strays = Made(path / "0002.mcap", Writer)
    strays.put("fleet/red/sensor/range", pb.Battery(voltage_v=0.1), 4.5)  # a message of another type on this key
    strays.close()
    return path.parent


def find(*arguments: object) -> subprocess.CompletedProcess[str]:
    return in_process.fleet("find", *arguments)


def damage(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Return the lines of stderr but those about the stray message, which each session has."""
    return [line for line in done.stderr.splitlines() if "not searched: 1 of fleet/red/sensor/range" not in line]


def hits(*arguments: object) -> list[dict[str, Any]]:
    return [json.loads(line) for line in find(*arguments, "--json").stdout.splitlines()]


def test_hit_has_mode_last_command_and_opens(sessions: Path, tmp_path: Path) -> None:
    (hit,) = hits(NEAR, sessions)
    assert (hit["session"], hit["car"], hit["length_s"]) == ("s 1", "red", 2.0)
    assert (hit["mode"], hit["command"]) == ("tracking", "drive by mia")
    assert hit["to"].endswith("Z")
    assert datetime.fromisoformat(hit["from"]).timestamp() == START_NS // S + 3
    done = find(NEAR, sessions)
    assert done.returncode == 0
    _, row, command = done.stdout.splitlines()
    assert row.split()[2] == "red"
    assert command.strip() == hit["open"]
    assert hit["link"] == f"http://127.0.0.1:{DEFAULT_PORT}/#/time?session=s%201&at={hit['from']}"
    time = command.rpartition(" ")[2]
    cut = in_process.fleet("sessions", "cut", sessions / "s 1", "--from", time, "--out", tmp_path / "part")
    assert cut.returncode == 0, cut.stderr
    assert find_in(Session(tmp_path / "part"), parse_condition(NEAR), ["red"]).hits[0].end_ns == START_NS + 5 * S


def other_range(value: "FieldDescriptorProto.Type.ValueType") -> FileDescriptorSet:
    """Return a schema in which the distance of fleet.v1.Range is of another type."""
    made = FileDescriptorSet()
    file = made.file.add(name="r.proto", package="fleet.v1", syntax="proto3")
    file.message_type.add(name="Range").field.add(
        name="range_m", number=5, type=value, label=FieldDescriptorProto.LABEL_OPTIONAL
    )
    return made


@pytest.mark.parametrize(
    ("encoding", "schema", "payload"),
    [
        ("json", b"", b'{"range_m": 0.1}'),
        ("protobuf", b"garbage", b"x"),
        ("protobuf", messages.descriptor_set("fleet.v1.Range"), b"\xff\xff"),
        ("protobuf", other_range(FieldDescriptorProto.TYPE_STRING).SerializeToString(), b"\x2a\x010"),
    ],
)
def test_messages_without_condition_value_are_counted(
    encoding: str, schema: bytes, payload: bytes, tmp_path: Path
) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer: Any = Writer(file)
        writer.start()
        kind = writer.register_schema("fleet.v1.Range", "protobuf" if encoding == "protobuf" else "jsonschema", schema)
        channel = writer.register_channel("fleet/red/sensor/range", encoding, kind)
        for number in range(3):
            writer.add_message(channel, START_NS + number, payload, START_NS)
        writer.finish()
    done = find(NEAR, tmp_path)
    assert done.returncode == 1
    assert "not searched: 3 of fleet/red/sensor/range: " in done.stderr


@pytest.mark.parametrize(
    "name",
    ["r; touch x #", "red\n  fleet estop --everything", "\x1b[2J", "r" * 60_000],
    ids=["shell", "two lines", "escape", "long"],
)
def test_recorded_names_become_no_command_and_no_terminal_flood(name: str, tmp_path: Path) -> None:
    made = Made(tmp_path / "a.mcap", Writer)
    made.put(f"fleet/{name}/sensor/range", pb.Range(range_m=0.1), 1)
    made.close()
    done = find(NEAR, tmp_path)
    header, row, command = done.stdout.splitlines()
    assert max(map(len, (header, row))) < 250
    assert "\x1b" not in done.stdout
    assert shlex.split(command) == ["fleet", "replay", str(tmp_path / "a.mcap"), "--from", shlex.split(command)[-1]]


def test_recorder_whose_clock_differs_has_hits_on_its_clock(tmp_path: Path) -> None:
    made = Made(tmp_path / "a.mcap", Writer)
    for second in range(10):
        message = pb.Range(range_m=0.1 if second in (4, 5) else 1.0, car="red", seq=second + 1, boot_id="b")
        at_ns = START_NS + second * S
        message.stamp.FromNanoseconds(at_ns)
        made.put_as_is("fleet/red/sensor/range", message, at_ns, at_ns - 3600 * S)
    made.close()
    (hit,) = hits(NEAR, tmp_path)
    assert datetime.fromisoformat(hit["from"]).timestamp() == START_NS // S + 4 - 3600
    opened = in_process.fleet(*shlex.split(hit["open"])[1:], "--save", tmp_path / "out.rrd")
    assert opened.returncode == 0, opened.stderr


@pytest.mark.parametrize(
    ("condition", "is_found"),
    [("hold", True), ("hold.by == 'teacher'", True), ("hold.by == 'mia'", False), ("safety.estops", False)],
)
def test_owner_conditions_match_person_names(condition: str, is_found: bool, tmp_path: Path) -> None:
    made = Made(tmp_path / "a.mcap", Writer)
    for second in range(3):
        made.put("fleet/red/state/safety", pb.Safety(hold=pb.Hold(by="teacher@vm-4711")), second)
    made.close()
    assert bool(find(condition, tmp_path, "--json").stdout) is is_found
    wait = ConditionWait(KeyCondition.of(condition, "fleet/red/state/safety"))
    reading = Reading.of("fleet/red/state/safety", pb.Safety(hold=pb.Hold(by="teacher@vm-4711")), START_NS)
    assert wait.ends(reading, reading.time, 1.0) is is_found


def test_condition_that_held_for_too_short_reads_so(sessions: Path) -> None:
    assert "but for 2.0s" in find(NEAR, sessions, "--for", "5s").stderr


def test_find_options_select_cars_and_times(sessions: Path) -> None:
    assert hits(NEAR, sessions, "--car", "blue") == []
    assert len(hits(NEAR, sessions, "--for", "2s")) == 1
    assert len(hits(NEAR, sessions, "--since", "2020-01-01")) == 1
    since = datetime.fromtimestamp(START_NS / S + 4).astimezone().isoformat()
    (later,) = hits(NEAR, sessions, "--since", since)
    assert later["length_s"] == 1.0
    assert {hit["car"] for hit in hits("range_m > 0.3", sessions)} == {"red", "blue"}
    never = find("range_m > 5", sessions)
    assert (never.returncode, never.stdout) == (1, "")
    assert find(NEAR, sessions, "--car", "pink").returncode == 2
    assert find(NEAR, sessions / "none").returncode == 1
    assert find(NEAR, sessions, "--since", "soon").returncode == 2


def test_damaged_sessions_are_named_and_the_rest_is_searched(sessions: Path) -> None:
    describe(sessions / "s 1")
    for name in ("cut", "empty", "noise"):
        shutil.copytree(sessions / "s 1", sessions / name)
    file = sessions / "cut" / "0001.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    (sessions / "empty" / "0001.mcap").write_bytes(b"")
    (sessions / "noise" / "0001.mcap").write_bytes(random.Random(1).randbytes(4000))
    done = find(NEAR, sessions)
    assert done.returncode == 0
    assert {line.partition(":")[0] for line in damage(done)} == {"cut", "empty", "noise"}
    assert {hit["session"] for hit in hits(NEAR, sessions)} == {"s 1", "cut"}
    older = find(NEAR, sessions, "--since", "1h")
    assert older.returncode == 1
    assert {line.partition(":")[0] for line in damage(older)} == {"empty", "noise", "fleet"}


def describe(session: Path, **values: object) -> Path:
    """Write session.json of a session that was closed."""
    whole = {"fleet": "fleet", "started": "", "host": "h", "versions": {}, "closed": True, "of_a_later_version": 1}
    file = session / SESSION_FILE
    file.write_text(json.dumps({**whole, **values}))
    return file


def test_csv_has_the_fields_of_json(sessions: Path) -> None:
    (hit,) = hits(NEAR, sessions)
    done = find(NEAR, sessions, "--csv")
    (row,) = csv.DictReader(io.StringIO(done.stdout))
    assert row == {name: str(value) for name, value in hit.items()}
    assert find(NEAR, sessions, "--csv", "--json").returncode == 2


def test_mark_is_added_once_to_closed_session(sessions: Path, tmp_path: Path) -> None:
    file = describe(sessions / "s 1", marks=[{"time": "2026-01-01T00:00:00Z", "text": "a cat", "by": "mia@h"}])
    recorded = (sessions / "s 1" / "0001.mcap").read_bytes()
    for _ in range(2):
        done = find(NEAR, sessions, "--mark", "--json")
        assert (done.returncode, damage(done)) == (0, [])
    first, mark = overview(sessions / "s 1").marks
    assert first["text"] == "a cat"
    assert mark["time"] == json.loads(done.stdout)["from"]
    assert mark["text"].endswith("red, 1 hit")
    values = json.loads(file.read_text())
    assert (values["kept"], values["of_a_later_version"]) == (True, 1), "the quota leaves it, and no field is lost"
    assert (sessions / "s 1" / "0001.mcap").read_bytes() == recorded
    assert mark["text"] in in_process.fleet("sessions", "info", sessions / "s 1").stdout
    replay = in_process.fleet("replay", sessions / "s 1", "--save", tmp_path / "out.rrd")
    assert replay.returncode == 0, replay.stderr
    texts = [
        text
        for chunk in rrc.RrdReader(tmp_path / "out.rrd").store().stream()
        if chunk.entity_path.endswith("@recorder/mark") and "TextLog:text" in chunk.to_record_batch().schema.names
        for (text,) in chunk.to_record_batch().column("TextLog:text").to_pylist()
    ]
    assert texts == [mark["text"]], "a mark that has a message is not drawn twice"


@pytest.mark.parametrize("kind", ["no description", "not closed", "of a later format", "noise", "one file"])
def test_unmarkable_session_is_named_and_left_alone(sessions: Path, kind: str) -> None:
    path = sessions / "s 1"
    if kind == "one file":
        path = sessions / "one.mcap"
        (sessions / "s 1" / "0001.mcap").rename(path)
        shutil.rmtree(sessions / "s 1")
    elif kind == "not closed":
        describe(path, closed=False)
    elif kind == "of a later format":
        describe(path, marks=3)
    elif kind == "noise":
        (path / SESSION_FILE).write_text("{")
    if others := path.is_dir():
        shutil.copytree(path, sessions / "t")
        describe(sessions / "t")
    before = {each: each.read_bytes() for each in sessions.rglob("*") if each.is_file() and each.parent.name != "t"}
    done = find(NEAR, sessions, "--mark")
    assert done.returncode == 1
    assert {line.partition(":")[0] for line in damage(done)} == {path.name}
    assert len(done.stdout.splitlines()) == (5 if others else 3), "the hits are shown all the same"
    assert {
        each: each.read_bytes() for each in sessions.rglob("*") if each.is_file() and each.parent.name != "t"
    } == before
    if others:
        assert len(overview(sessions / "t").marks) == 1


def test_each_topic_of_a_condition_has_a_known_age() -> None:
    assert all(TOPICS[topic].stale_after_s is not None for topic in ("sensor/range", "state/mode", "state/safety"))
