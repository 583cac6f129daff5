"""`fleet plan try`: the same plan makes the recorded decisions, and another plan makes others."""

import json
import signal
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from mcap.writer import Writer

from fleet.cli import cli
from fleet.client.client import Fleet
from fleet.recording import time_spec
from fleet.recording.reading.session import Recorded, Session
from fleet.replay.analysis.decision_differences import DecisionDifference, differences
from fleet.replay.analysis.recorded_decisions import (
    PresenceToken,
    RecordedDecision,
    Timeline,
    add,
    presence,
)
from schemas import messages
from schemas.bus import Failure
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.conftest import Cars
from tests.fleet.replay.make_session import Made
from tests.support.processes import GatewayProcess, wait_for

S = 1_000_000_000
PLAN = """
roles:
  track: {mode: tracking, cars: [red]}
  rest: {mode: manual, cars: [blue, green], count: all}
rules:
  - name: spinning
    when: {car: green, is: motion.motion == 'spin_left'}
    then: {who: red, mode: light_seeking}
phases: {first: {next: second}, second: {}}
"""
OTHER = PLAN.replace("spin_left", "spin_right")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def command(client: Fleet, verb: str) -> None:
    payload = pb.PlanCommand(sender=client.sender, kind="person").SerializeToString()
    encoding = messages.encoding_of("fleet.v1.PlanCommand")
    key = f"fleet/@coordinator/@cmd/{verb}"
    (answer,) = client.bus.query(key, payload=payload, encoding=encoding, timeout_s=10.0)
    assert not isinstance(answer, Failure), answer


def coordinator(cars: Cars, plan: Path) -> GatewayProcess:
    return cars.start("-m", "fleet.cli", "plan", "run", str(plan), "--json")


def until(process: GatewayProcess, subject: str, kind: str) -> None:
    while True:
        line = process.line()
        if (line["subject"], line["kind"]) == (subject, kind):
            return


@pytest.fixture(scope="module")
def recorded(cars: Cars, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a rule, a hold, a killed gateway, a killed and restarted coordinator, and a new plan."""
    plan = tmp_path_factory.mktemp("plan") / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    recorder = cars.start("-m", "fleet.cli", "record", "--sessions", str(plan.parent), "--json")
    session = Path(recorder.line()["session"])
    first = coordinator(cars, plan)
    until(first, "red", "role")
    with Fleet(cars.endpoint, sender="ann", kind="person") as client:
        command(client, "next")
        until(first, "phase", "phase")
        drive = threading.Thread(target=lambda: client.car("green").drive("spin_left", 5.0))
        drive.start()  # longer than the tolerance of a difference, also if the coordinator gets it late
        until(first, "red", "rule")
        drive.join()
        until(first, "red", "role")
        # The recording needs the hold. On a busy machine the report that shows the stop may come too late.
        wait_for(lambda: client.car("red").stop().ok, "a shown stop")
        until(first, "red", "alone")
        client.car("red").resume().check()
        until(first, "red", "role")
        cars.gateways["blue"].kill()
        until(first, "blue", "alone")
        cars.gateways["blue"].wait()
        cars.gateways["blue"] = cars.serve("blue")
        until(first, "blue", "role")
        first.kill()
        first.wait()
        wait_for(lambda: not client.bus.tokens("fleet/@coordinator"), "its token is gone")
        second = coordinator(cars, plan)
        until(second, "red", "role")
        command(client, "stop")
        until(second, "red", "alone")
        command(client, "restart")
        until(second, "red", "role")
        # The recording needs the hold. On a busy machine the report that shows the stop may come too late.
        wait_for(lambda: client.car("red").stop().ok, "a shown stop")
        until(second, "red", "alone")
        client.car("red").resume().check()
        until(second, "red", "role")
        key = "fleet/@coordinator/@cmd/plan"
        answers = list(
            client.bus.query(key, payload=b"fixed: {red: {mode: manual}}\n", encoding="text/plain", timeout_s=10.0)
        )
        assert len(answers) == 1
        until(second, "red", "role")
        modes = "red is in the new plan's mode"
        wait_for(lambda: any(each["asked"] == "manual" for each in client.get("red/state/mode")), modes)
    assert second.end(signal.SIGINT) == 0
    assert recorder.end() == 0
    return session


def test_replan_of_same_plan_has_no_difference(recorded: Path) -> None:
    result = run("plan", "try", recorded, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output.splitlines()[-1])
    assert summary["differences"] == 0
    assert summary["decisions"] >= 12
    assert len(summary["spans_s"]) == 2
    assert summary["begun_before"] == 0


def test_plan_try_shows_first_difference_with_readings(recorded: Path, tmp_path: Path) -> None:
    plan = tmp_path / "other.yaml"
    plan.write_text(OTHER, encoding="utf-8")
    result = run("plan", "try", recorded, plan, "--json")
    assert result.exit_code == 1
    first = json.loads(result.output.splitlines()[0])
    assert first["subject"] == "red"
    assert (first["then"]["kind"], first["then"]["decided"]) == ("rule", "light_seeking")
    assert "motion=spin_left" in first["then"]["readings"][0]
    assert (first["now"]["kind"], first["now"]["decided"]) == ("role", "tracking")
    told = run("plan", "try", recorded, plan).output
    assert "  then: light_seeking (role track), because: rule spinning: green: motion.motion == 'spin_left'" in told


@pytest.mark.parametrize(
    ("kind", "decided", "words"),
    [
        ("alone", "left alone", "left alone"),
        ("out", "not wanted", "not wanted"),
        ("filled", "1 of all", "cars: 1"),
        ("vacant", "0 of 1", "cars: 0 of 1"),
        ("idle", "manual", "manual (no role)"),
    ],
)
def test_recorded_decision_has_plain_words(kind: str, decided: str, words: str) -> None:
    assert str(RecordedDecision(0, kind, decided, "")) == words


def test_redecode_of_replanned_session_has_no_difference(recorded: Path) -> None:
    result = run("sessions", "redecode", recorded)
    assert result.exit_code == 0, result.output


def test_replan_of_cut_recording_compares_from_its_begin(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "part"
    # The coordinator publishes the plan every ten seconds. Between the first two there is no other.
    first, second, *_ = (each.recorded_ns for each in Session(recorded).messages(["fleet/@coordinator/plan"]))
    between = ("--from", time_spec.iso(first + S), "--to", time_spec.iso(second))
    assert run("sessions", "cut", recorded, *between, "--out", out).exit_code == 0
    assert "no plan" in run("plan", "try", out).output
    (out / "plan.yaml").write_text(PLAN, encoding="utf-8")
    result = run("plan", "try", out, "--json")
    summary = json.loads(result.output.splitlines()[-1])
    assert (summary["differences"], summary["begun_before"]) == (0, 1), result.output


def test_replan_refuses_session_without_decided_cars(recorded: Path, tmp_path: Path) -> None:
    for source, out, more in ((recorded, "red", ["--car", "red"]), (tmp_path / "red", "part", ["--from", "1s"])):
        assert run("sessions", "cut", source, *more, "--out", tmp_path / out).exit_code == 0
        result = run("plan", "try", tmp_path / out)
        assert result.exit_code == 1
        assert "cut to red" in result.output
        assert "depended on blue, green" in result.output
        assert "then:" not in result.output


def said(at_s: float, decided: str) -> RecordedDecision:
    return RecordedDecision(int(at_s * S), "role", decided, "")


def timeline(*found: RecordedDecision) -> Timeline:
    made: Timeline = {}
    for each in found:
        add(made, "red", each)
    return made


def test_differences_are_stretches_of_time() -> None:
    then = timeline(said(1, "tracking"), said(5, "tracking"), said(8, "manual"))
    assert len(then["red"]) == 2  # a repeated message is no new decision
    assert list(differences(then, then, 0, 20 * S)) == []
    now = timeline(said(1.5, "tracking"), said(4, "following"), said(8, "manual"))
    assert list(differences(then, now, 0, 20 * S)) == [
        DecisionDifference("red", 1 * S, int(1.5 * S), then["red"][0], None),
        DecisionDifference("red", 4 * S, 8 * S, then["red"][0], now["red"][1]),
    ]
    assert list(differences(then, {}, 0, 3 * S)) == [DecisionDifference("red", 1 * S, 3 * S, then["red"][0], None)]
    # Two decisions in a row are two.
    changing = timeline(said(1, "a"), said(2, "b"))
    assert [(each.from_ns, each.to_ns) for each in differences(changing, {}, 0, 3 * S)] == [(S, 2 * S), (2 * S, 3 * S)]


def state(at_s: float, boot: str) -> Recorded:
    payload = pb.Link(car="red", boot_id=boot).SerializeToString()
    at_ns = int(at_s * S)
    return Recorded("fleet/red/state/link", payload, "fleet.v1.Link", "protobuf", at_ns, at_ns, 1)


def test_presence_lasts_while_states_come() -> None:
    states = [*(state(at, "a") for at in (1, 2, 3)), *(state(at, "b") for at in (3.4, 4)), state(9, "b")]
    found = presence(states, 20 * S)
    assert [(token.at_ns / S, token.alive) for token in found] == [
        (1.0, True),
        (3.2, False),
        (3.4, True),
        (4.5, False),
        (9.0, True),
        (9.5, False),
    ]
    assert presence(states[:3], 5 * S) == [PresenceToken(S, "red", alive=True)]


def test_bad_input_is_told_in_a_line(tmp_path: Path) -> None:
    empty = tmp_path / "none.mcap"
    made = Made(empty, Writer)
    made.put("fleet/red/state/mode", pb.Mode(asked="manual"), 1.0)
    made.close()
    result = run("plan", "try", empty)
    assert result.exit_code == 1
    assert "no decisions" in result.output

    old = tmp_path / "old.mcap"
    made = Made(old, Writer)
    made.put("fleet/@coordinator/plan", pb.Plan(text="{: no plan"), 1.0)
    made.put("fleet/@coordinator/decision", pb.Decision(subject="red", decided="manual", kind="role"), 1.1)
    made.close()
    result = run("plan", "try", old)
    assert result.exit_code == 2
    assert "recorded plan" in result.output
    assert "Traceback" not in result.output

    without = tmp_path / "without.mcap"
    made = Made(without, Writer)
    made.put("fleet/@coordinator/decision", pb.Decision(subject="red", decided="manual", kind="role"), 1.1)
    made.close()
    assert "no plan" in run("plan", "try", without).output
    assert run("plan", "try", without, tmp_path / "nowhere.yaml").exit_code == 2
    assert run("plan", "try", tmp_path / "nowhere").exit_code == 1
    assert run("plan", "try", without, "--tolerance", "0").exit_code == 2


def test_replan_accepts_other_plan_name_in_fleet_file(tmp_path: Path) -> None:
    """The session has the plan as plan.yaml, and a car without a link was simulated then."""
    made = Made(tmp_path / "0001.mcap", Writer)
    for at in range(3):
        made.put("fleet/@coordinator/decision", pb.Decision(subject="red", decided="left alone", kind="alone"), at + 1)
    made.close()
    (tmp_path / "plan.yaml").write_text("fixed: {red: {mode: manual}}", encoding="utf-8")
    text = "plan: p2.yaml\nworld: w2.yaml\ncars: {red: {platform: arduino}}\n"
    (tmp_path / "fleet.yaml").write_text(text, encoding="utf-8")
    result = run("plan", "try", tmp_path)
    assert "decisions from" in result.output, result.output
    other = tmp_path / "other.yaml"
    other.write_text(text, encoding="utf-8")
    named = run("plan", "try", tmp_path, "--fleet-file", other)
    assert named.exit_code == 2
    assert f"there is no file {tmp_path / 'p2.yaml'}" in named.output
