"""Replays a session to the bus: under another name, byte for byte, on time, and without taking commands."""

import json
import random
import signal
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap.writer import Writer

from fleet.client.condition import KeyCondition
from fleet.client.reading import Reading
from fleet.client.wait import ConditionWait
from fleet.policy.car_condition import parse_condition
from fleet.recording.reading.session import Recorded, Session
from fleet.recording.tools.condition_search import find_in
from fleet.replay.player.player import Player
from fleet.replay.player.schedule import Schedule
from schemas import bus
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.replay.make_session import START_NS, Made, make
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess, wait_for
from tests.support.text_parts import has_parts

S = 1_000_000_000


class InOrder(Writer):
    """A writer that sorts messages by time, as a recorder's are."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._given: list[tuple[Any, ...]] = []

    def add_message(self, *message: Any) -> None:
        self._given.append(message)

    def finish(self) -> None:
        for message in sorted(self._given, key=itemgetter(1)):
            super().add_message(*message)
        super().finish()  # type: ignore[no-untyped-call]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "made.mcap"
    make(path, seconds=6, writer=InOrder)
    return path


def play(fleet: FleetProcesses, session: Path, *more: str) -> GatewayProcess:
    return fleet.start("-m", "fleet.cli", "play", str(session), *more)


def test_schedule_has_one_origin() -> None:
    every = Schedule(rate=3.0)
    assert [every.due_s(START_NS + number * S // 10) for number in range(4)] == pytest.approx([0, 1 / 30, 2 / 30, 0.1])
    # After 10^9 steps of a tenth of a second, the error is less than a thousandth.
    long = Schedule()
    long.played_ns = 10**17
    assert long.due_s(0) == 1e8
    assert long.due_s(S // 10) == 1e8 + 0.1
    # Pauses are shortened, a clock that went back stands still, and a loop continues at its end.
    gaps = Schedule(rate=2.0, longest_gap_ns=5 * S)
    assert [gaps.due_s(at * S) for at in (0, 4, 104, 103, 104)] == [0.0, 2.0, 4.5, 4.5, 5.0]
    assert gaps.shortened == 1
    gaps.again(S)
    assert [gaps.due_s(at * S) for at in (0, 1)] == [5.5, 6.0]


def test_all_of_it_comes_again_as_it_was(fleet: FleetProcesses, session: Path) -> None:
    got: list[bus.Sample] = []
    for expression in ("again/**", "again/@coordinator/**", "again/@recorder/**", "again/@sim/**"):
        fleet.bus.subscribe(expression, got.append)
    player = play(fleet, session, "--as", "again", "--rate", "3")
    assert player.wait() == 0
    lines = player.lines()
    then: dict[str, list[Recorded]] = {}
    for one in Session(session).messages():
        if "/@supervisor/" not in one.key:
            then.setdefault(one.key.replace("fleet/", "again/", 1), []).append(one)
    wait_for(lambda: len(got) == sum(map(len, then.values())), "all has come")
    now: dict[str, list[bus.Sample]] = {}
    for sample in got:
        now.setdefault(sample.key, []).append(sample)
    assert now.keys() == then.keys()
    for key, ones in then.items():
        assert [sample.payload for sample in now[key]] == [one.payload for one in ones], key
        assert [sample.sequence for sample in now[key]] == [one.sequence for one in ones], key
        assert {sample.encoding for sample in now[key]} == {f"application/protobuf;{ones[0].message}"}
    # Six seconds at triple speed. Compare publication times, not arrival times: the distance of each message to the
    # last one is a third of the recorded one, less a delay by this machine. At least one message has almost no delay.
    put = [
        (one.recorded_ns / 3, sample.time_ns)
        for key, ones in then.items()
        for one, sample in zip(ones, now[key], strict=True)
    ]
    (due_last, put_last), early = max(put), [each for each in put if each[0] < max(put)[0] - S / 2]
    assert max((put_last - at) - (due_last - due) for due, at in early) > -0.05 * S
    assert lines[0].startswith("made as fleet again ")
    assert "3 times " in lines[0]
    assert ": blue, green, red; " in lines[0]


@pytest.mark.parametrize(("seed", "for_s"), [(1, 0.0), (2, 2.0), (3, 5.0)])
def test_watch_of_replay_hits_when_find_does(seed: int, for_s: float, fleet: FleetProcesses, tmp_path: Path) -> None:
    chance, at_s = random.Random(seed), 0.0
    made = Made(tmp_path / "made.mcap", InOrder)
    for _ in range(60):
        at_s += chance.choice([0.1, 0.5, 1.0, 1.0, 2.9, 3.1])
        reading = chance.choice([pb.Range(range_m=0.1)] * 6 + [pb.Range(range_m=0.5), pb.Range(no_echo=True)])
        made.put("fleet/red/sensor/range", reading, at_s)
    made.close()
    condition, key = "range_m < 0.3", "again/red/sensor/range"
    wait, came, ended = ConditionWait(KeyCondition.of(condition, key), for_s), 0, []

    def on_sample(sample: bus.Sample) -> None:
        nonlocal came
        came += 1
        reading = Reading.of(key, sample.message(), sample.time_ns)
        if wait.ends(reading, reading.time):
            ended.append(reading.time.timestamp())

    fleet.bus.subscribe(key, on_sample)
    assert play(fleet, tmp_path / "made.mcap", "--as", "again", "--rate", "200").wait() == 0
    wait_for(lambda: came == 60, "all has come")
    hits = find_in(Session(tmp_path / "made.mcap"), parse_condition(condition), ["red"], for_s).hits
    assert hits
    spans = [(hit.begin_ns / S + for_s, hit.end_ns / S) for hit in hits]
    assert all(any(begin - 1e-3 <= at <= end + 1e-3 for begin, end in spans) for at in ended)
    assert all(any(begin - 1e-3 <= at <= end + 1e-3 for at in ended) for begin, end in spans)


def test_player_looks_like_fleet_and_takes_no_command(fleet: FleetProcesses, session: Path) -> None:
    player = play(fleet, session, "--loop", "--rate", "20")
    wait_for(lambda: len(fleet.bus.tokens("fleet-replay/*")) == 3, "the cars are there")
    wait_for(lambda: fleet.get("fleet-replay/*/state/mode"), "something was said")
    assert fleet.bus.tokens("fleet-replay/@replay/*") == ["fleet-replay/@replay/made"]
    listed = fleet.start("-m", "fleet.cli", "list", "--fleet", "fleet-replay", "--json")
    assert listed.wait() == 0
    assert {json.loads(row)["replay"] for row in listed.lines()} == {"made"}
    assert "replay of made" in listed.stderr

    waited = fleet.start("-m", "fleet.cli", "wait", "red/sensor/range", "range_m >= 0", "--fleet", "fleet-replay")
    assert waited.wait() == 0, "it is old, and published now"

    key, words = "fleet-replay/*/@cmd/stop", "fleet fleet-replay is a replay of made: it accepts no commands"
    found = fleet.bus.query(key, timeout_s=PATIENCE_S)
    answers = [json.loads(each.payload) for each in found if isinstance(each, bus.Sample)]
    assert {(each["car"], each["status"], each["words"]) for each in answers} == {
        (car, "rejected", words) for car in ("red", "green", "blue")
    }
    asked = fleet.start("-m", "fleet.cli", "drive", "red", "forward", "--fleet", "fleet-replay")
    assert asked.wait() == 1
    assert words in asked.stderr

    second = play(fleet, session)
    assert second.wait() == 2
    assert "fleet-replay " in second.stderr
    assert "--as" in second.stderr
    assert player.end(signal.SIGINT) == 0
    wait_for(lambda: not fleet.bus.tokens("fleet-replay/*"), "it is gone")


def test_player_loops_over_selected_part(fleet: FleetProcesses, session: Path) -> None:
    got: list[bus.Sample] = []
    fleet.bus.subscribe("fleet-replay/**", got.append)
    part = ("--car", "red", "--from", "2s", "--to", "4s", "--offset", "1s", "--cars-only", "--loop", "--rate", "10")
    player = play(fleet, session, *part)

    def ranges() -> list[int]:
        return [sample.sequence for sample in got if sample.key.endswith("sensor/line")]

    wait_for(lambda: sum(before > after for before, after in pairwise(ranges())) >= 2, "two rounds are over")
    assert player.end(signal.SIGINT) == 0
    assert {sample.key.split("/")[1] for sample in got} == {"red"}
    first, second, *_ = (number for before, number in pairwise([1 << 31, *ranges()]) if number < before)
    assert first > second  # only the first round begins at --offset


def test_player_answers_with_values_from_before_offset(fleet: FleetProcesses, session: Path) -> None:
    player = play(fleet, session, "--offset", "4500ms", "--rate", "0.1")
    # A battery is measured in mode manual only: until second 2.
    battery = wait_for(lambda: fleet.get("fleet-replay/red/sensor/battery"), "the battery")
    assert [one.stamp.ToNanoseconds() for one in battery] == [START_NS + S + 60_000_000]
    assert player.end(signal.SIGINT) == 0


def test_player_does_not_wait_for_clock_that_went_back(fleet: FleetProcesses, tmp_path: Path) -> None:
    recording = Made(tmp_path / "back.mcap", Writer)
    for at_s in (3600.0, 3600.1, 0.0, 0.1):
        recording.put("fleet/red/sensor/range", pb.Range(range_m=0.4), at_s)
    recording.close()
    player = play(fleet, tmp_path / "back.mcap")
    assert player.wait() == 0
    assert player.lines()[-1].startswith("4 messages in ")


def test_player_ended_before_first_message_is_no_fault(fleet: FleetProcesses, session: Path) -> None:
    player = play(fleet, session, "--from", "2s", "--rate", "0.01")
    wait_for(lambda: fleet.bus.tokens("fleet-replay/red"), "it has begun")
    assert player.end(signal.SIGINT) == 0
    assert not player.stderr


def live(fleet: FleetProcesses, token: str) -> None:
    """Declare a liveliness token."""
    fleet.bus.token(token)
    with bus.Bus.open(fleet.endpoint) as other:
        wait_for(lambda: other.tokens(token), "the hub knows of it")


def test_player_refuses_name_of_living_fleet(fleet: FleetProcesses, session: Path) -> None:
    live(fleet, "again/red")
    player = play(fleet, session, "--as", "again")
    assert player.wait() == 2
    assert "(red): " in player.stderr
    assert "--as" in player.stderr
    # Also without cars yet. --cars-only is for a policy that waits for the recorded cars.
    live(fleet, "third/@supervisor")
    assert play(fleet, session, "--as", "third", "--cars-only").wait() == 2
    live(fleet, "tried/@coordinator")
    both = play(fleet, session, "--as", "tried")
    assert both.wait() == 2
    assert "(@coordinator): " in both.stderr
    assert "--cars-only" in both.stderr
    assert play(fleet, session, "--as", "tried", "--cars-only", "--rate", "100").wait() == 0


def test_player_refuses_name_of_recorded_fleet(fleet: FleetProcesses, session: Path) -> None:
    player = play(fleet, session, "--as", "fleet")
    assert player.wait() == 2
    assert "--as fleet " in player.stderr


def test_commands_of_a_recording_are_not_given_again(fleet: FleetProcesses, tmp_path: Path) -> None:
    recording = Made(tmp_path / "driven.mcap", Writer)
    recording.put("fleet/red/@cmd/drive", Log(message="drive"), 0.0)
    recording.put("fleet/red/sensor/range", pb.Range(range_m=0.4), 0.1)
    recording.close()
    got: list[str] = []
    for expression in ("fleet-replay/**", "fleet-replay/*/@cmd/*"):
        fleet.bus.subscribe(expression, lambda sample: got.append(sample.key))
    assert play(fleet, tmp_path / "driven.mcap").wait() == 0
    wait_for(lambda: got, "the reading has come, before which the command would have")
    assert got == ["fleet-replay/red/sensor/range"]
    # The player by itself publishes no command, either.
    player = Player(fleet.bus, "direct", "")
    player.play(Session(tmp_path / "driven.mcap").messages(), Schedule(), 0.0, lambda: False, lambda _: None)
    assert player.published == 1


def test_player_replaces_killed_hub(fleet: FleetProcesses, session: Path) -> None:
    player = play(fleet, session, "--loop")
    wait_for(lambda: fleet.get("fleet-replay/red/state/mode"), "something was said")
    fleet.hub.kill()
    got: list[bus.Sample] = []
    fleet.bus.subscribe("fleet-replay/red/sensor/*", got.append)
    wait_for(lambda: got, "something is said again")
    assert player.end(signal.SIGINT) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--as", "Not a name"), "(--as) 'Not a name' "),
        (("--offset", "9h"), "outside the selected"),
        (("--skip-gaps", "soon"), '--skip-gaps: "soon" … duration'),
        (("--skip-gaps", "0s"), "--skip-gaps: 0s … than 0"),
        (("--save", "x.rrd"), "--save"),
        (("--rate", "0"), "--rate"),
        (("--car", "nobody"), "nobody "),
    ],
)
def test_wrong_use_is_told_in_a_line(
    fleet: FleetProcesses, session: Path, arguments: tuple[str, ...], words: str
) -> None:
    player = play(fleet, session, *arguments)
    assert player.wait() == 2
    assert has_parts(player.stderr, words)
    assert len(player.stderr.splitlines()) == 1
