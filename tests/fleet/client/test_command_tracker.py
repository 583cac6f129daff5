"""`fleet keys`, `fleet wait`, `fleet watch --when`, and the same in the SDK: real gateways, pipes and terminals."""

import asyncio
import contextlib
import json
import math
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet import aio
from fleet import cli as command_line
from fleet.client.condition import KeyCondition, topics_under
from fleet.client.key_survey import KeySurvey
from fleet.client.reading import Reading
from fleet.client.wait import ConditionWait, NotInTime
from fleet.conditions import BadExpression
from schemas import keys, topics
from schemas.bus import Bus, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.conftest import Cars, running
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses as Processes
from tests.support.processes import wait_for
from tests.support.text_parts import has_parts

FLEET = [sys.executable, "-m", "fleet.cli"]
NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


def run(endpoint: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [*FLEET, *arguments, "--connect", endpoint]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def on_a_terminal(endpoint: str, *arguments: str) -> str:
    """Run a command at a terminal. Return its output as a person sees it."""
    controller, device = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"} | {"TERM": "xterm"}
    shown = b""
    with subprocess.Popen([*FLEET, *arguments, "--connect", endpoint], stdout=device, stderr=device, env=environment):
        os.close(device)
        with contextlib.suppress(OSError):  # the last process on the terminal has ended
            while piece := os.read(controller, 4096):
                shown += piece
    os.close(controller)
    return shown.decode()


# ---------------------------------------------------------------------- keys


def test_keys_are_those_alive_with_type_unit_rate_and_age(cars: Cars) -> None:
    done = run(cars.endpoint, "keys", "--json", "--for", "4s")
    assert (done.returncode, done.stderr) == (0, "")
    rows = {row["key"]: row for row in map(json.loads, done.stdout.splitlines())}
    assert list(rows) == sorted(rows)
    assert {key.split("/")[1] for key in rows} == {"red", "green", "blue"}
    battery = rows["fleet/red/sensor/battery"]
    assert (battery["type"], battery["units"]["voltage_v"]) == ("fleet.v1.Battery", "V")
    assert 0.2 < battery["rate_hz"] < 5, "about once a second"
    assert 0 <= battery["age_s"] < 4, "it came while it was looked"
    assert rows["fleet/red/event/command"]["age_s"] is None
    for car in cars.gateways:
        assert 0.2 < rows[f"fleet/{car}/state/health"]["rate_hz"] < 5
    assert "fleet/blue/sensor/battery" not in rows, "a Raspberry Pi car measures none"


def test_watch_prints_table_on_terminal_and_plain_text_in_pipe(cars: Cars) -> None:
    plain = run(cars.endpoint, "keys", "red/sensor/range", "--for", "5s").stdout.splitlines()
    assert plain[0].split() == ["KEY", "TYPE", "UNIT", "RATE", "AGE"]
    assert plain[1].split()[:3] == ["fleet/red/sensor/range", "fleet.v1.Range", "m"]
    assert plain[1].split()[4::2] == ["Hz", "s"]
    assert "\x1b" not in "".join(plain)
    shown = on_a_terminal(cars.endpoint, "keys", "red/sensor/range", "--for", "100ms")
    assert shown.startswith("\x1b[1mKEY ")
    assert "fleet/red/sensor/range" in shown
    assert "\x1b" not in on_a_terminal(cars.endpoint, "get", "red/sensor/range", "--last", "2", "--csv")


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        ("keys purple", 1, 'No car "purple". … blue, green, red.'),
        ("keys --fleet empty", 1, 'No fleet "empty" … : fleet.'),
        ("keys red/@cmd/*", 2, "fleet/red/@cmd/* … command, … reading"),
    ],
)
def test_keys_that_are_not_there(cars: Cars, arguments: str, code: int, told: str) -> None:
    done = run(cars.endpoint, *arguments.split(), "--for", "100ms")
    assert (done.returncode, done.stdout) == (code, "")
    assert has_parts(done.stderr, told)
    assert done.stderr.count("\n") == 1


def reading(topic: str, seq: int, age_s: float, boot: str = "a", **fields: Any) -> Reading:
    kind = {"sensor/range": pb.Range, "state/mode": pb.Mode, "event/command": pb.CommandEvent}[topic]
    return Reading(f"fleet/red/{topic}", NOW - timedelta(seconds=age_s), kind(seq=seq, boot_id=boot, **fields))


@pytest.mark.parametrize(
    ("seen", "rate", "age_s"),
    [
        ([(1, 2.0), (2, 1.0), (3, 0.0)], 1.0, 0.0),
        ([(1, 2.0), (51, 0.0)], 25.0, 0.0),  # most were missed
        ([(7, 60.0), (8, 0.5)], None, 0.5),  # one within the observed time
        ([(7, 60.0)], None, 60.0),
        ([(1, 0.02), (2, 0.0)], 0.4, 0.0),  # two that arrived together count as two
        ([(3, 0.0), (1, 2.0)], 1.0, 0.0),  # in any order
        ([(0, 2.0), (900, 1.0)], None, 1.0),  # an answer to a query may have no number
        ([(0, 2.0), (900, 1.0), (901, 0.0)], 1.0, 0.0),
    ],
)
def test_rate_is_counted_by_the_publishers_numbers(
    seen: list[tuple[int, float]], rate: float | None, age_s: float
) -> None:
    survey = KeySurvey(2.5)
    for seq, age in seen:
        survey.add(reading("sensor/range", seq, age), NOW)
    (found,) = survey.keys([], NOW)
    assert (found.rate_hz, found.age_s) == (rate, age_s)


def test_publisher_that_began_anew_counts_anew() -> None:
    survey = KeySurvey(2.5)
    for seq, age, boot in ((900, 2.0, "a"), (1, 1.0, "b"), (2, 0.0, "b")):
        survey.add(reading("sensor/range", seq, age, boot), NOW)
    (found,) = survey.keys([], NOW)
    assert found.rate_hz == 1.0


# ---------------------------------------------------------------------- wait


def test_wait_ends_at_once_if_the_current_value_is_so(cars: Cars) -> None:
    done = run(cars.endpoint, "wait", "red/state/mode", "asked == 'manual'", "--timeout", "20s", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["value"]["asked"] == "manual"


def test_wait_ends_when_it_becomes_so(cars: Cars) -> None:
    command = [*FLEET, "wait", "*/state/mode", "asked == 'tracking'", "--for", "1s", "--connect", cars.endpoint]
    with running(command) as process:
        try:
            assert run(cars.endpoint, "mode", "red", "tracking").returncode == 0
            out, err = process.communicate(timeout=40)
        finally:
            run(cars.endpoint, "mode", "red", "manual")
    assert (process.returncode, err) == (0, "")
    assert out.startswith("fleet/red/state/mode  ")
    assert "asked=tracking" in out


def test_wait_says_what_was_instead_when_the_time_is_over(cars: Cars) -> None:
    done = run(cars.endpoint, "wait", "red/state/safety", "estops and motors == 'on'", "--timeout", "3s")
    assert (done.returncode, done.stdout) == (1, "")
    words = "fleet: estops and motors == 'on' did not hold within 3 s: fleet/red/state/safety had "
    assert done.stderr.startswith(words)
    assert re.search(r"estops=false, motors='(off|stopping)", done.stderr)
    assert done.stderr.endswith(" s ago\n")
    done = run(cars.endpoint, "wait", "purple/sensor/range", "range_m < 1", "--timeout", "100ms")
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        'fleet: No car "purple" is connected yet. Connected: blue, green, red. Waiting.',
        "fleet: range_m < 1 did not hold within 0.1 s: nothing came under fleet/purple/sensor/range",
    ]


def test_wait_is_ended_by_ctrl_c_without_a_word(cars: Cars) -> None:
    command = [*FLEET, "wait", "red/sensor/range", "range_m > 11", "--connect", cars.endpoint]
    with running(command) as process:
        operators = f"fleet/{keys.OPERATOR}/*"
        there = f"-{process.pid}"
        wait_for(lambda: [token for token in cars.bus.tokens(operators) if token.endswith(there)], "it is on the bus")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err.strip()) == (130, "", "")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["wait", "red"], "KEY … CONDITION"),
        (["wait", "red//x", "a < 1"], '"red//x" … key'),
        (["wait", "red/sensor/range", "range < 1"], "column 1: range … mean range_m?"),
        (["wait", "red/sensor/range", "range_m < 1 and range_m > 2"], "range_m < 1 and range_m > 2 is never true"),
        (["wait", "*/state/motion", "motion == 'forwards'"], "never true: motion … stop, forward, back"),
        (["wait", "*/sensor/battery", "not voltage_v < 50"], "is never true: voltage_v is 0 .. 13"),
        (["watch", "*/state/mode", "--when", "verdict == 'wrong'"], "verdict … assumed, confirmed"),
        (["wait", "red/sensor/sonar", "range_m < 1"], "No key red/sensor/sonar."),
        (["wait", "red/@cmd/drive", "motion == 'stop'"], "No key red/@cmd/drive."),
        (["wait", "red", "range_m < 1 and voltage_v > 7"], "under fleet/red/sensor/* "),
        (["wait", "red", "left", "--timeout", "0"], "--timeout: 0 … than 0"),
        (["wait", "red", "left", "--timeout", "1s", "--for", "2s"], "--for 2 s … --timeout 1 s"),
        (["watch", "red/sensor/range", "--when", "range_m"], "range_m … number, … condition"),
        (["watch", "red/sensor/line", "--when", "left_outer > 1"], "left_outer … yes or no: > "),
        (["watch", "red", "--count", "0"], "--count: 0 … 1"),
        (["keys", "red?x"], '"red?x" … key'),
        (["keys", "--for", "1d"], '--for: "1d" … duration'),
    ],
)
def test_wrong_use_is_found_before_anyone_is_asked(
    arguments: list[str], told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["fleet", *arguments])
    monkeypatch.setenv("FLEET_ENDPOINT", free_endpoint())  # no hub listens there
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    said = capsys.readouterr()
    assert (ended.value.code, said.out) == (2, "")
    assert has_parts(said.err, told)
    assert said.err.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [["keys"], ["wait", "red", "left"], ["get", "red", "--last", "3"], ["watch", "red"]]
)
def test_without_a_fleet_each_says_what_to_do(arguments: list[str]) -> None:
    endpoint = free_endpoint()
    done = run(endpoint, *arguments)
    assert done.returncode == 1
    assert "Nothing is running yet." in done.stderr
    assert f"`fleet up --connect {endpoint}`" in done.stderr
    assert done.stderr.count("\n") == 1


# ---------------------------------------------------------------------- watch with a condition


def test_watch_filters_and_ends_after_count(cars: Cars) -> None:
    done = run(cars.endpoint, "watch", "red", "--when", "voltage_v > 0", "--count", "2", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert [json.loads(line)["key"] for line in done.stdout.splitlines()] == ["fleet/red/sensor/battery"] * 2
    shown = on_a_terminal(cars.endpoint, "watch", "*/state/mode", "--when", "verdict != 'contradicted'", "--count", "1")
    assert "/state/mode  " in shown


async def test_sdk_does_the_same_both_ways(cars: Cars) -> None:
    async with aio.Fleet(cars.endpoint) as fleet:
        assert len(await fleet.history("red/state/mode", last=5)) == 1
        found = await fleet.wait("*/state/health", "pid > 0", timeout_s=20)
        assert found.key.endswith("/state/health")
        assert await asyncio.to_thread(fleet.sync.wait, "red/state/mode", "asked == 'manual'", timeout_s=20)
        for late in (
            fleet.wait("red/state/mode", "asked == 'following'", timeout_s=3),
            asyncio.to_thread(fleet.sync.wait, "red/state/mode", "asked == 'following'", timeout_s=3),
        ):
            with pytest.raises(NotInTime, match="had asked='manual', ") as ended:
                await late
            assert ended.value.last is not None
            assert ended.value.last.value.asked == "manual"
        async with fleet.watch("red/state/*", when="uptime_s > 0") as readings:
            assert (await anext(readings)).key == "fleet/red/state/health"
        with fleet.sync.watch("red/state/*", when="uptime_s > 0") as stream:
            assert next(stream).key == "fleet/red/state/health"
        with pytest.raises(BadExpression):
            await fleet.wait("red", "nothing > 1")
        with pytest.raises(BadExpression):
            fleet.sync.watch("red", when="nothing > 1")


# ---------------------------------------------------------------------- between the current value and the next ones


class Flicker:
    """A car whose range is far in the answer to a query, and near for one message right after it."""

    def __init__(self, bus: Bus) -> None:
        self._topic = topics.TOPICS["sensor/range"]
        self._publisher = bus.publisher("fleet/red/sensor/range", self._topic, "red")
        bus.queryable("fleet/red/sensor/*", self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        far = pb.Range(car="red", range_m=2.0)
        far.stamp.seconds, far.stamp.nanos = divmod(time.time_ns(), 1_000_000_000)
        with query:
            reply_value(query, "fleet/red/sensor/range", far.SerializeToString(), self._topic)
        threading.Thread(target=lambda: self._publisher.put(pb.Range(range_m=0.1), time.time_ns())).start()


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    fleet = Processes(free_endpoint(), tmp_path)
    try:
        yield fleet.endpoint
    finally:
        fleet.close()


async def test_watch_loses_no_reading_between_query_and_subscription(endpoint: str) -> None:
    with Bus.open(endpoint) as bus:
        Flicker(bus)
        async with aio.Fleet(endpoint) as fleet:
            for _ in range(20):
                assert (await fleet.wait("red/sensor/range", "range_m < 1", timeout_s=20)).value.range_m == 0.1
                found = await asyncio.to_thread(fleet.sync.wait, "red/sensor/range", "range_m < 1", timeout_s=20)
                assert found.value.range_m == 0.1


# ---------------------------------------------------------------------- pure


def test_topics_that_a_key_expression_can_match() -> None:
    assert [topic.name for topic in topics_under("fleet/red/sensor/range")] == ["sensor/range"]
    assert [topic.name for topic in topics_under("fleet/*/*/battery")] == ["sensor/battery"]
    assert [topic.name for topic in topics_under("fleet/@recorder/**")] == ["@recorder/status", "@recorder/mark"]
    assert {topic.family for topic in topics_under("fleet/**")} == {"sensor", "state", "frame", "event", "sim"}
    assert topics_under("fleet/red/@cmd/*") == []


def close(for_s: float = 0.0) -> ConditionWait:
    return ConditionWait(KeyCondition.of("range_m < 0.3", "fleet/*/sensor/range"), for_s)


def ends(waiting: ConditionWait, seen: list[tuple[float, float | None]], end_s: float = 100.0) -> list[bool]:
    """Return whether each reading, given as (time, distance), ends the wait."""
    found = []
    for number, (at, range_m) in enumerate(seen):
        taken = reading("sensor/range", number, end_s - at, range_m=range_m)
        found.append(waiting.ends(taken, taken.time))
    return found


@pytest.mark.parametrize("for_s", [math.nan, math.inf, -1.0])
def test_wait_for_what_is_no_time(for_s: float) -> None:
    with pytest.raises(ValueError, match="for_s"):
        close(for_s)


@pytest.mark.parametrize(
    ("for_s", "seen", "found"),
    [
        (0.0, [(1, 0.5), (2, 0.2)], [False, True]),
        (0.0, [(1, None), (2, 0.2)], [False, True]),
        (0.0, [(2, 0.5), (1, 0.2)], [False, False]),  # older than the newest reading
        (2.0, [(1, 0.2), (2, 0.2), (3, 0.2)], [False, False, True]),
        (2.0, [(1, 0.2), (2, 0.4), (3, 0.2), (4, 0.2), (5, 0.2)], [False, False, False, False, True]),
        (2.0, [(1, 0.2), (2, None), (3, 0.2)], [False, False, False]),  # an unmeasured value breaks the series
        (2.0, [(1, 0.2), (5, 0.2), (6, 0.2), (7, 0.2)], [False, False, False, True]),  # the gap may hide another value
        (0.5, [(1, 0.2), (1.4, 0.2), (1.5, 0.2)], [False, False, True]),
    ],
)
def test_how_long_it_must_have_held(for_s: float, seen: list[tuple[float, float | None]], found: list[bool]) -> None:
    assert ends(close(for_s), seen) == found


def test_wait_holds_per_key_and_stale_value_does_not_count() -> None:
    waiting = close(1.0)
    red = reading("sensor/range", 1, 2.0, range_m=0.2)
    blue = Reading("fleet/blue/sensor/range", NOW, pb.Range(range_m=0.2))
    assert not waiting.ends(red, red.time)
    assert not waiting.ends(blue, blue.time)
    assert not close().ends(reading("sensor/range", 1, 3.1, range_m=0.2), NOW)
    assert close().ends(reading("sensor/range", 1, 2.9, range_m=0.2), NOW)


def test_wait_timeout_error_words() -> None:
    waiting = close(1.5)
    assert str(waiting.timeout_error("fleet/red/sensor/range", 5.0, NOW)) == (
        "range_m < 0.3 did not hold for 1.5 s within 5 s: nothing came under fleet/red/sensor/range"
    )
    waiting.ends(reading("sensor/range", 1, 9.0, no_echo=True), NOW)
    assert str(waiting.timeout_error("x", 5.0, NOW)).endswith(
        ": fleet/red/sensor/range had range_m=not measured, 9.0 s ago (stale)"
    )
    waiting.ends(reading("sensor/range", 2, 2.0, range_m=0.5), NOW)
    late = waiting.timeout_error("x", 5.0, NOW)
    assert str(late).endswith(": fleet/red/sensor/range had range_m=0.5, 2.0 s ago")
    assert late.last is not None
    assert late.last.value.range_m == 0.5
