"""`gateway run` as a real process: its publications, frames, refusals, restarts and files."""

import json
import os
import random
import signal
import socket
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import serial

from fleet.client.car_state import CarState
from fleet.client.diagnosis import CarEvidence, diagnose
from schemas import bus
from schemas.limits import SHUTDOWN_S
from tests.support.judge import Judge
from tests.support.kills import BUSY_S
from tests.support.ports import free_endpoint
from tests.support.processes import (
    MODE00,
    PATIENCE_S,
    PI_REPORT,
    TAKEN,
    FleetProcesses,
    GatewayProcess,
    TcpCar,
    driving,
    wait_for,
)
from tests.support.text_parts import has_parts

ANY_CLIENT = Path(__file__).parent / "any_client.py"

STOP = b"$0,0,0,0,0,0,0,0,0#"
RUN = b"$1,0,0,0,0,0,0,0,0#"

# Bytes of a car, and their readings: docs/reference/protocol.md#readings.
LAST = b"$4WD,CSB33.00,PV7.25,GS7,LF0000,HW00,GM00#"
RECORDED: list[tuple[bytes, dict[str, dict[str, Any]]]] = [
    (b"BT-04 ready\r\n", {}),
    (
        b"$4WD,CSB125.50,PV8.3,GS214,LF1011,HW01,GM10#\r\n",
        {
            "range": {"range_m": 1.255},
            "battery": {"voltage_v": 8.3, "level": "ok"},
            "grayscale": {"raw": 214},
            "line": {"left_outer": True, "left_inner": False, "right_inner": True, "right_outer": True},
            "obstacle": {"left": False, "right": True},
            "light": {"left": True, "right": False},
        },
    ),
    (b"$4WD,CSB12", {}),  # cut by a reset
    (
        b"$4WD,CSB0.00,PV6.5,GS1023,LF0000,HW10,GM01#",
        {
            "range": {"no_echo": True, "range_m": 0.0},
            "battery": {"voltage_v": 6.5, "level": "ok"},  # a level needs several readings
            "grayscale": {"raw": 1023},
            "line": {"left_outer": False},
            "obstacle": {"left": True, "right": False},
            "light": {"left": False, "right": True},
        },
    ),
    (b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#", {"line": {"left_outer": True, "left_inner": False}}),  # tracking
    (b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM10#", {"light": {"left": True, "right": False}}),  # light seeking
    (b"$4WD,CSB120,PV8.3,GS000,LF0000,HW01,GM00", {}),  # of mode following, while mode 0 is confirmed
    (
        b"$4WD,CSB2000,PV7.91,GS5,LF0201,HW00,GM11#",  # two of its fields are out of range
        {
            "battery": {"voltage_v": 7.91},
            "grayscale": {"raw": 5},
            "obstacle": {"left": False, "right": False},
            "light": {"left": True, "right": True},
        },
    ),
    (b"$4WD,J190,J280,J370,J460,J50,J6180#", {"arm": {"joint_deg": [90, 80, 70, 60, 0, 180]}}),
    (
        b"$4WD,MPUgx-1,MPUgy2,MPUgz3.5,MPUax4,MPUay5,MPUaz-16384#",
        {"imu": {"gyro_x_raw": -1.0, "gyro_z_raw": 3.5, "accel_z_raw": -16384.0}},
    ),
    (b"$4WD,XYZ1#\xff\x00$" + b"9" * 300 + b"#", {}),
    (
        LAST,
        {
            "range": {"range_m": 0.33},
            "battery": {"voltage_v": 7.25},
            "grayscale": {"raw": 7},
            "line": {"left_outer": False},
            "obstacle": {"left": False},
            "light": {"left": False},
        },
    ),
]
OF_OTHER_MODES = (
    b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#",
    b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM10#",
    b"$4WD,CSB120,PV8.3,GS000,LF0000,HW01,GM00",
)
OF_A_RASPBERRY_PI: list[tuple[bytes, dict[str, dict[str, Any]]]] = [
    (
        b"$4WD,CSB125,PV8.4,GS0,LF1011,HW01,GM10#",  # its voltage and its grayscale are constants
        {
            "range": {"range_m": 1.25},
            "line": {"left_outer": True},
            "obstacle": {"right": True},
            "light": {"left": True},
        },
    ),
    (b"hello\r\n", {}),
    (
        b"$4WD,CSB0,PV8.4,GS0,LF0000,HW00,GM00#",
        {"range": {"no_echo": True}, "line": {}, "obstacle": {}, "light": {}},
    ),
]


@pytest.mark.parametrize(
    ("platform", "recording", "report", "basis", "connected", "stopped"),
    [
        ("arduino+arm+imu", RECORDED, LAST, "shown", [b"#", MODE00, MODE00, STOP], [MODE00, STOP]),
        ("raspberry_pi", OF_A_RASPBERRY_PI, PI_REPORT, "sent", [STOP, STOP, STOP], [STOP, STOP, STOP]),
    ],
    ids=["arduino", "raspberry_pi"],
)
def test_gateway_writes_and_publishes_over_plain_tcp_server(
    fleet: FleetProcesses,
    tcp_car: TcpCar,
    platform: str,
    recording: list[tuple[bytes, dict[str, dict[str, Any]]]],
    report: bytes,
    basis: str,
    connected: list[bytes],
    stopped: list[bytes],
) -> None:
    published: defaultdict[str, list[Any]] = defaultdict(list)
    fleet.bus.subscribe("fleet/red/sensor/*", lambda sample: published[sample.key[17:]].append(sample.message()))
    raw = bytearray()
    fleet.bus.subscribe("fleet/red/frame/rx", lambda sample: raw.extend(sample.message().data))  # type: ignore[attr-defined]
    told: list[Any] = []
    fleet.bus.subscribe("fleet/red/frame/tx", lambda sample: told.append(sample.message()))
    fleet.gateway(tcp_car.link, platform=platform)
    wait_for(lambda: len(tcp_car.received) >= len(connected), "what it is sent on connecting")
    assert tcp_car.received[: len(connected)] == connected

    whole = b"".join(data for data, _ in recording)
    # A frame of another mode is one piece: its readings depend on the mode's verdict, computed five times a second.
    others = b"".join(data for data, _ in recording if data in OF_OTHER_MODES)
    before, _, after = whole.partition(others) if others else (whole, b"", b"")
    cuts = random.Random(5)
    for part in (*pieces(before, cuts), others + after[:1], *pieces(after[1:], cuts)):  # a `$` ends a frame without `#`
        tcp_car.send(part)
        time.sleep(0.005)  # so that pieces arrive as pieces
    expected: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    for _, readings in recording:
        for name, fields in readings.items():
            expected[name].append(fields)
    wait_for(lambda: recording[-1][0] in raw, "the last frame is published")
    counts = {name: len(readings) for name, readings in expected.items()}
    wait_for(lambda: all(len(published[name]) >= count for name, count in counts.items()), "its readings, too")
    assert published.keys() == expected.keys()
    for name, readings_of in expected.items():
        got = [
            {field: plain(getattr(one, field)) for field in fields}
            for one, fields in zip(published[name], readings_of, strict=True)
        ]
        assert got == readings_of, name
        assert [one.seq for one in published[name]] == list(range(1, len(got) + 1))
    assert strip(raw) == strip(whole), "every byte is in one raw frame"

    if basis == "shown":
        assert fleet.state("safety").motors == "unknown", "readings alone confirm no stop"
    tcp_car.obey(report)
    fleet.ready()
    assert fleet.state("safety").motors_basis == basis
    assert fleet.ask("drive", motion="forward", duration_s=10)["status"] in TAKEN
    wait_for(lambda: tcp_car.received.count(RUN) == 2, "the drive, and its repetition")
    assert fleet.ask("stop")["status"] in TAKEN
    wait_for(lambda: len(frames_of("stop", told)) >= len(stopped), "the stop")
    wait_for(lambda: fleet.state("safety").motors == "off", "it stands")
    assert fleet.state("safety").motors_basis == basis
    assert frames_of("recovery", told)[: len(connected)] == connected
    assert frames_of("command", told) == [RUN]
    # If the repetition may be unread, the general stop goes first.
    assert frames_of("stop", told)[: len(stopped)] in (stopped, stopped[::-1])
    assert {frame.data for frame in told if frame.data != RUN} <= {b"#", MODE00, STOP}, "until the car showed it"
    wait_for(lambda: tcp_car.received == [frame.data for frame in told], "one write per frame, and no other")
    assert tcp_car.received.count(RUN) == 2
    assert tcp_car.connections == 1


def pieces(data: bytes, cuts: random.Random) -> Iterator[bytes]:
    """Yield the data in pieces, cut at random places."""
    while data:
        size = cuts.choice([1, 1, 2, 5, 20, 20, 60])
        yield data[:size]
        data = data[size:]


def frames_of(why: str, told: list[Any]) -> list[bytes]:
    """Return the frames that were written for a reason, in order."""
    return [frame.data for frame in told if frame.why == why]


def plain(value: Any) -> Any:
    return list(value) if hasattr(value, "append") else value


def strip(data: bytes | bytearray) -> bytes:
    """Return the data without separators, which belong to no frame."""
    return bytes(data).translate(None, b"\r\n \t")


def test_any_zenoh_client_reads_and_drives(fleet: FleetProcesses) -> None:
    assert len([line for line in ANY_CLIENT.read_text().splitlines() if line]) <= 10
    sim, (link,) = fleet.simulate("red:raspberry_pi:tcp")
    fleet.gateway(link, platform="raspberry_pi")
    fleet.ready()
    wait_for(lambda: fleet.get("fleet/red/sensor/range"), "a reading")
    before = sim.say({"car": "red", "ask": "truth"})
    client = fleet.start(str(ANY_CLIENT))
    reading, answer = client.line(), client.line()
    assert client.wait() == 0, client.stderr
    assert (reading["car"], 0 < reading["range_m"] < 12) == ("red", True)
    assert (answer["car"], answer["status"] in TAKEN, answer["reason"]) == ("red", True, "")
    wait_for(lambda: sim.say({"car": "red", "ask": "truth"})["x_m"] != before["x_m"], "it moves")
    wait_for(lambda: not driving(sim), "and stops by itself")


def test_history(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    fleet.gateway(tcp_car.link, platform="raspberry_pi")
    wait_for(lambda: tcp_car.received, "it is on the link")
    for number in range(1, 6):
        tcp_car.send(b"$4WD,CSB%d,PV8.4,GS0,LF0000,HW00,GM00#" % number)
    wait_for(lambda: len(fleet.get("fleet/red/sensor/range?last=9")) == 5, "five readings")

    def ranges(parameters: str) -> list[int]:
        return [round(message.range_m * 100) for message in fleet.get(f"fleet/red/sensor/range?{parameters}")]

    assert ranges("") == [5]
    assert ranges("last=3") == [3, 4, 5]
    assert ranges("_time=[now(-10m)..]") == [1, 2, 3, 4, 5]
    assert ranges("_time=[now(-10m)..];last=2") == [4, 5]
    assert ranges("_time=[..now(-10m)]") == []
    third = fleet.get("fleet/red/sensor/range?last=3")[0].stamp.ToJsonString()
    assert ranges(f"_time=[{third}..];last=9")[-2:] == [4, 5]
    assert len(fleet.get("fleet/red/sensor/*?last=2")) == 2 * 4
    assert len(fleet.get("fleet/**")) == 4 + 5, "four readings and five states, and no command was asked"
    for bad in ("last=0", "last=x", "last=-1", "_time=now", "_time=[2026-11-21T04:00:00Z;10s]", "format=xml"):
        (words,) = fleet.get(f"fleet/red/sensor/range?{bad}")
        assert isinstance(words, str), bad
        assert bad.partition("=")[0] in words
    assert fleet.get("fleet/red/sensor/nonsense") == []


def test_bad_commands_are_answered_and_nothing_dies(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    told: list[Any] = []
    fleet.bus.subscribe("fleet/red/frame/tx", lambda sample: told.append(sample.message()))
    tcp_car.obey(PI_REPORT)
    gateway = fleet.gateway(tcp_car.link, platform="raspberry_pi")
    fleet.ready()
    assert tcp_car.received[:3] == [STOP, STOP, STOP], "recovery"
    records: list[Any] = []
    fleet.bus.subscribe("fleet/red/event/command", lambda sample: records.append(sample.message()))
    for verb, fields, reason in [
        ("drive", {"motion": "forward", "sender": "x" * 5_000_000}, "bad_value"),
        ("drive", {}, "bad_value"),
        ("drive", {"motion": "forward", "duration_s": "NaN"}, "bad_value"),
        ("mode", {"mode": "tracking"}, "unsupported"),
        ("jump", {}, "unsupported"),
        ("led", {"r": 1, "g": 2, "b": 300}, "bad_value"),
        ("light", {"light": "yellow"}, "unsupported"),
    ]:
        answer = fleet.ask(verb, **fields)  # type: ignore[arg-type]  # joined to object
        assert (answer["status"], answer["reason"]) == ("rejected", reason), verb
        assert answer["words"]
    for selector in ("fleet/*/@cmd/drive", "fleet/red/@cmd/*"):
        (answer,) = list(fleet.bus.query(selector, payload=b'{"motion": "forward"}', timeout_s=5.0))
        words = answer.words if isinstance(answer, bus.Failure) else json.loads(answer.payload)["words"]
        assert "name" in words
    for data in (b"", b"{", b"\xff" * 100, b"[" * 60_000, b"[" * 5_000_000):
        for encoding in ("application/json", "application/protobuf", "application/protobuf;fleet.v1.DriveCommand"):
            assert len(list(fleet.bus.query("fleet/red/@cmd/drive", payload=data, encoding=encoding))) == 1
            fleet.bus.put_command("fleet/red/@cmd/drive", data, encoding)
    answers = list(fleet.bus.query("fleet/*/@cmd/stop", payload=b"[" * 5_000_000, timeout_s=5.0))
    (result,) = [json.loads(one.payload) for one in answers if isinstance(one, bus.Sample)]
    assert result["status"] in TAKEN
    assert " 5000000 " in result["words"]
    wait_for(lambda: len(frames_of("stop", told)) == 3, "the stop")
    wait_for(lambda: fleet.state("safety").motors == "off", "it stands")
    assert len(frames_of("stop", told)) == 3, "and nothing else"
    assert not frames_of("command", told)
    assert set(tcp_car.received) == {STOP}
    wait_for(lambda: any(record.verb == "stop" for record in records), "the stop is recorded")
    assert max(len(record.request) for record in records) == 60_000
    assert gateway.end() == 0
    assert "Traceback" not in gateway.stderr


def test_second_gateway_refuses_and_names_first(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    tcp_car.obey(PI_REPORT)
    first = fleet.gateway(tcp_car.link, platform="raspberry_pi")
    fleet.ready()
    second = fleet.gateway("/dev/ttyNOWHERE", platform="raspberry_pi")
    assert second.wait() == 1
    (line,) = second.stderr.splitlines()
    assert line.startswith(
        f"gateway: car red already has a gateway, process {first.pid} on {socket.gethostname()} (link {tcp_car.link}): "
    )
    assert fleet.ask("drive", motion="forward", duration_s=0.1)["status"] in TAKEN


def remaining(fleet: FleetProcesses, both: list[GatewayProcess]) -> GatewayProcess:
    """Wait until one of two has yielded and the other has looked again."""
    wait_for(lambda: any(one.popen.poll() is not None for one in both), "one yields")
    ended = [one for one in both if one.popen.poll() is not None]
    assert len(ended) == 1, [(one.wait(), one.stderr) for one in ended]
    (yields,) = ended
    (stays,) = [one for one in both if one is not yields]
    assert yields.wait() == 1
    assert "already has a gateway" in yields.stderr or "in use" in yields.stderr
    wait_for(lambda: (health := fleet.state("health")) and health.uptime_s > 2.0, "the other has looked again")
    assert stays.popen.poll() is None
    fleet.ready()
    assert [health.pid for health in fleet.get("fleet/red/state/health")] == [stays.pid]
    return stays


def test_of_two_that_want_one_port_one_remains(fleet: FleetProcesses) -> None:
    _, (link,) = fleet.simulate("red:raspberry_pi:pty")
    remaining(fleet, [fleet.gateway(link, platform="raspberry_pi") for _ in range(2)])


AT_THE_WORD = """
import sys
import gateway.car_gateway, gateway.cli, gateway.link.tcp
sys.stdout.write("0\\n")
sys.stdout.flush()
sys.stdin.readline()
gateway.cli.main()
"""


def test_of_two_that_start_at_the_same_moment_one_remains(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    """In two of three rounds, neither gateway sees the other in time. Repeat until it happens, for a while."""
    tcp_car.obey(PI_REPORT)
    arguments = ("run", "--car", "red", "--link", tcp_car.link, "--platform", "raspberry_pi")
    for attempt in range(1, 6):
        both = [fleet.start("-c", AT_THE_WORD, *arguments) for _ in range(2)]
        for one in both:
            one.line()
        for one in both:
            one.popen.stdin.write("\n")
            one.popen.stdin.flush()
        stays = remaining(fleet, both)
        if tcp_car.connections > attempt:
            return
        stays.end(signal.SIGKILL)
        wait_for(lambda: not fleet.get("fleet/red/**"), "it is gone")


SEES_NOBODY_FIRST = """
import os
os.urandom = bytes([0]).__mul__
from gateway import cli
from schemas.bus import Singleton
looks = iter([lambda _: [], *[Singleton.others] * 99])
Singleton.others = lambda self: next(looks)(self)
cli.main()
"""
LOOKS_AGAIN_AT_THE_WORD = """
import os, sys
os.urandom = bytes([255]).__mul__
from gateway import cli
from schemas.bus import Singleton
look, before = Singleton.others, iter([lambda: None, sys.stdin.readline])
Singleton.others = lambda self: (next(before)(), look(self))[1]
cli.main()
"""


def test_remaining_gateway_gets_port_of_yielding_one(fleet: FleetProcesses) -> None:
    """Neither saw the other in time; the one with the higher id was faster to open the port, and looks again later."""
    _, (link,) = fleet.simulate("red:arduino:pty")
    arguments = ("run", "--car", "red", "--link", link, "--platform", "arduino")
    yields = fleet.start("-c", LOOKS_AGAIN_AT_THE_WORD, *arguments)
    fleet.ready()
    stays = fleet.start("-c", SEES_NOBODY_FIRST, *arguments)
    wait_for(lambda: "in use" in stays.stderr, "it cannot have the port")
    yields.popen.stdin.write("\n")
    yields.popen.stdin.flush()
    assert remaining(fleet, [yields, stays]) is stays


FOUR = ("red:arduino:pty", "green:arduino:tcp", "blue:raspberry_pi:tcp", "white:arduino:pty")


@dataclass
class Four:
    """Start four cars with their gateways."""

    fleet: FleetProcesses
    sim: GatewayProcess
    gateways: dict[str, GatewayProcess]
    judges: dict[str, Judge]


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Four]:
    fleet = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("four"))
    try:
        names = [each.split(":")[0] for each in FOUR]
        judges = {car: Judge.follow(fleet.bus, car) for car in names}
        sim, links = fleet.simulate(*FOUR, truth=True)
        gateways = {
            car: fleet.gateway(link, car=car, platform=each.split(":")[1])
            for car, each, link in zip(names, FOUR, links, strict=True)
        }
        yield Four(fleet, sim, gateways, judges)
    finally:
        fleet.close()


@pytest.mark.parametrize(
    ("number", "car"),
    [(signal.SIGINT, "red"), (signal.SIGTERM, "green"), (signal.SIGTERM, "blue"), (signal.SIGHUP, "white")],
    ids=["SIGINT-arduino", "SIGTERM-arduino", "SIGTERM-raspberry_pi", "SIGHUP-arduino"],
)
def test_signal_stops_car_before_gateway_ends(four: Four, number: int, car: str) -> None:
    fleet, sim, gateway, judge = four.fleet, four.sim, four.gateways[car], four.judges[car]
    fleet.ready(car)
    assert fleet.ask("drive", car, motion="forward", duration_s=10)["status"] in TAKEN
    wait_for(lambda: judge.driving, "it drives")
    asked_ns = time.time_ns()
    assert gateway.end(number) == 0, gateway.stderr
    ended_s = (time.time_ns() - asked_ns) / 1e9
    assert not driving(sim, car)
    took_s = judge.wait_off(asked_ns, watched_s=0.5)
    assert took_s < min(1.2 + BUSY_S, ended_s), "its recipe, on a machine that is busy, and before it ends"
    assert ended_s < SHUTDOWN_S + 1.0 + 2 * BUSY_S, "the time for evidence that it announces, and the end of a process"
    assert "Traceback" not in gateway.stderr
    assert fleet.left() == []
    assert wait_for(lambda: not fleet.get(f"fleet/{car}/**"), "nobody answers for it")


def test_driver_is_told_at_once_of_killed_gateway(fleet: FleetProcesses) -> None:
    """Only a person can stop the car then, and must learn of the kill before the end of the drive."""
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    gateway = fleet.gateway(link)
    fleet.ready()
    drive = fleet.start("-m", "fleet.cli", "drive", "red", "forward", "--for", "9s")
    wait_for(lambda: driving(sim), "it drives")
    gateway.end(signal.SIGKILL)
    assert drive.wait() == 1
    assert "red may be moving" in drive.stderr
    assert driving(sim)


def test_killed_joystick_stops_car(fleet: FleetProcesses) -> None:
    """Kill a sender with a token that streams drives. The car stops long before the end of the last drive."""
    sim, (link,) = fleet.simulate("red:raspberry_pi:tcp")
    fleet.gateway(link, platform="raspberry_pi")
    fleet.ready()
    records: list[Any] = []
    fleet.bus.subscribe("fleet/red/event/command", lambda sample: records.append(sample.message()))
    written: list[str] = []
    fleet.bus.subscribe("fleet/red/frame/tx", lambda sample: written.append(sample.message().why))  # type: ignore[attr-defined]
    joystick = fleet.start(str(Path(__file__).parent / "joystick.py"))
    wait_for(lambda: written[-1:] == ["repeat"], "it drives, and a second of the stream has passed")
    assert driving(sim)
    joystick.end(signal.SIGKILL)
    wait_for(lambda: not driving(sim), "it stops", 8.0)
    wait_for(lambda: records[-1].words == "its sender stick disconnected", "it is said")
    # After a stall of half a second, the gateway stops the car and accepts the stream again. It rejects a drive that
    # was in transit for longer.
    taken = [record for record in records if record.reason != "stale"]
    assert [record.phase for record in taken[-3:]] == ["queued", "sent", "expired"]
    assert len(taken) % 3 == 0
    assert taken[-1].count > 1


def test_killed_gateway_leaves_car_driving_until_successor_stops_it(fleet: FleetProcesses) -> None:
    sim, (link,) = fleet.simulate("red:arduino:pty")
    gateway = fleet.gateway(link)
    fleet.ready()
    assert fleet.ask("stop", sender="mia", kind="person")["status"] in TAKEN
    wait_for(lambda: fleet.state("safety").hold.by == "mia", "held")
    assert fleet.ask("drive", motion="forward", kind="coordinator")["reason"] == "held"
    gateway.end(signal.SIGKILL)
    wait_for(lambda: not fleet.get("fleet/red/**"), "it is gone")

    said: list[Any] = []
    fleet.bus.subscribe("fleet/red/state/safety", lambda sample: said.append(sample.message()))
    gateway = fleet.gateway(link)
    fleet.ready()
    first = wait_for(lambda: said, "a successor")[0]
    assert first.hold.by == "mia", "a hold survives"
    assert first.motors == "unknown"
    assert fleet.state("safety").hold.by == "mia"
    assert fleet.ask("drive", motion="forward", duration_s=10)["status"] in TAKEN
    assert not fleet.state("safety").HasField("hold"), "a script's drive ends it"
    wait_for(lambda: driving(sim), "it drives")
    gateway.end(signal.SIGKILL)
    assert driving(sim), "the car has no dead-man"

    fleet.gateway(link)
    wait_for(lambda: not driving(sim), "recovery stops it")
    fleet.ready()
    assert not fleet.state("safety").HasField("hold"), "its end survives too"


def test_dropped_link_reconnects(fleet: FleetProcesses, tmp_path: Path) -> None:
    sim, (link,) = fleet.simulate(f"red:arduino:pty:{tmp_path / 'tty'}")
    gateway = fleet.gateway(link)
    fleet.ready()
    assert fleet.ask("drive", motion="forward", duration_s=10, id="long")["status"] in TAKEN
    ends: list[Any] = []
    fleet.bus.subscribe("fleet/red/event/command", lambda sample: ends.append(sample.message()))
    wait_for(lambda: driving(sim), "it drives")
    sim.say({"car": "red", "fault": "link_drop"})
    wait_for(lambda: fleet.state("link").state == "lost", "lost")
    assert driving(sim)
    assert fleet.state("safety").motors == "unknown"
    answer = fleet.ask("drive", motion="forward")
    assert (answer["status"], answer["reason"]) == ("rejected", "link_down")
    sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
    wait_for(lambda: not driving(sim), "recovery stops it")
    fleet.ready()
    wait_for(lambda: fleet.state("link").state == "online", "online")
    assert fleet.state("link").reconnects == 1
    ended = [(end.phase, end.reason) for end in ends if end.id == "long" and end.phase not in TAKEN]
    assert ended == [("failed", "link_down")]
    assert fleet.ask("drive", motion="forward", duration_s=0.3)["status"] in TAKEN
    assert gateway.end() == 0


def test_bytes_that_are_no_readings_are_not_called_silence(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    """The link carries noise, too little of it to doubt the baud rate. Nobody should look for a car that is off."""
    fleet.gateway(tcp_car.link)
    wait_for(lambda: tcp_car.received, "it has connected")

    def known() -> CarState:
        tcp_car.send(b"\xf8")
        state = CarState("red")
        for topic in ("link", "safety", "health"):
            state.take(f"state/{topic}", fleet.state(topic), time.time())
        return state

    wait_for(lambda: known().is_unreadable, "the noise counts as bytes that are no readings")
    state = known()
    assert has_parts(state.why_not_ready(time.time()) or "", "bytes come, but no reading")
    found = {each.code for each in diagnose(CarEvidence(state, time.time(), asked=True))}
    assert "no_reading" in found
    assert "silent" not in found


def test_link_that_dies_at_once_is_not_reopened_in_a_loop(fleet: FleetProcesses) -> None:
    """Each opening of a real port may reset the car's board. A log line for each opening would flood the log."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        gateway = fleet.gateway(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        times = []
        for _ in range(9):
            peer, _ = server.accept()
            times.append(time.monotonic())
            peer.close()
        assert times[8] - times[3] > 2.0, "at least half a second each, once it has happened a few times"
        assert gateway.stderr.count("[link_open]") == 1
        said = [line.partition("WARNING ")[2] for line in gateway.stderr.splitlines() if "WARNING" in line]
        causes = [words.removeprefix("red: a write failed: ").removeprefix("red: ") for words in said]
        assert len(causes) == len(set(causes)) > 0
    gateway.end()


def test_killed_hub_returns_and_commands_work_again(fleet: FleetProcesses) -> None:
    sim, links = fleet.simulate("red:raspberry_pi:tcp", "blue:raspberry_pi:tcp")
    fleet.gateway(links[0], platform="raspberry_pi")
    fleet.gateway(links[1], platform="raspberry_pi", car="blue")
    fleet.ready("red")
    fleet.ready("blue")
    fleet.hub.end(signal.SIGKILL)
    wait_for(lambda: fleet.left() and bus.accepts(fleet.endpoint), "another hub")
    assert wait_for(lambda: fleet.bus.tokens("fleet/*") == ["fleet/blue", "fleet/red"], "both are back")
    for car in ("red", "blue"):

        def drives(car: str = car) -> bool:  # after a stall, the gateway stops its car: send the drive again
            return fleet.ask("drive", car, motion="forward", duration_s=5)["status"] in TAKEN and driving(sim, car)

        wait_for(drives, f"{car} drives")
        assert fleet.ask("stop", car)["status"] in TAKEN
        wait_for(lambda car=car: not driving(sim, car), f"{car} stands")


@pytest.fixture(scope="module")
def only_a_hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetProcesses]:
    """Start a hub for gateways that never open a link."""
    started = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("hub"))
    assert started.bus.connected, "a hub without a client ends by itself"
    yield started
    started.close()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--car", "Red"], 2, "'Red' … 1 to 32 of a-z"),
        (["--car", ""], 2, "car name '' is not allowed"),
        (["--fleet", "a/b"], 2, "fleet name 'a/b' is not allowed"),
        (["--platform", "esp32"], 2, 'Unknown platform "esp32". There are arduino, stm32, raspberry_pi, unknown, '),
        (["--platform", "arduino+wings"], 2, 'Unknown option "+wings"'),
        (["--link", "usb://x"], 2, "not a link. `fleet scan`"),
        (["--link", "tcp://host"], 2, "port is missing. … tcp://host:8888"),
        (["--link", "ttyUSB0"], 2, "not a link"),
        (["--connect", "127.0.0.1:7447"], 2, "write it as tcp/HOST:PORT"),
        (["--connect", "tcp/127.0.0.1:0"], 2, "port 1 to 65535"),
        (["--connect", "tcp/192.0.2.1:7447"], 1, "Nothing answers at tcp/192.0.2.1:7447"),
        (["--link", "/dev/ttyNOWHERE"], 1, "serial:///dev/ttyNOWHERE: no such port"),
        (["--link", "/dev"], 1, "serial:///dev: … directory, … serial port"),
        (["--link", "tcp://127.0.0.1:1"], 1, "nothing listens"),
        (["--link", f"tcp://{'a' * 64}:8888"], 1, "no host"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else "",
)
def test_bad_input_is_one_line(only_a_hub: FleetProcesses, arguments: list[str], code: int, words: str) -> None:
    given = {"--car": "red", "--link": "/dev/null", "--platform": "arduino"}
    given |= dict(zip(arguments[::2], arguments[1::2], strict=True))
    process = only_a_hub.start("-m", "gateway.cli", "run", *(word for pair in given.items() for word in pair))
    assert process.wait() == code, process.stderr
    (line,) = process.stderr.splitlines()
    assert line.startswith("gateway: ")
    assert has_parts(line, words)


def test_gateway_names_process_that_uses_port(fleet: FleetProcesses) -> None:
    _, (link,) = fleet.simulate("red:arduino:pty")
    with serial.Serial(link.removeprefix("serial://"), exclusive=True):
        process = fleet.gateway(link)
        assert process.wait() == 1
    (line,) = process.stderr.splitlines()
    assert f"by process {os.getpid()} (" in line


def test_gateway_names_listener_that_is_no_zenoh_router(tmp_path: Path, fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    process = fleet.gateway("/dev/null", "--connect", tcp_car.link.replace("tcp://", "tcp/"))
    assert process.wait() == 1
    (line,) = process.stderr.splitlines()
    assert "Zenoh router" in line


def test_retry_waits_for_missing_link(fleet: FleetProcesses, tmp_path: Path) -> None:
    gateway = fleet.gateway(str(tmp_path / "tty"), "--retry", platform="raspberry_pi")
    wait_for(lambda: (link := fleet.state("link")) and "no such port" in link.reason, "it says what is missing")
    fleet.simulate(f"red:raspberry_pi:pty:{tmp_path / 'tty'}")
    fleet.ready()
    assert gateway.end() == 0


def test_signal_without_link_ends_gateway_at_once(fleet: FleetProcesses, tmp_path: Path) -> None:
    gateway = fleet.gateway(str(tmp_path / "tty"), "--retry")
    wait_for(lambda: fleet.state("link"), "it runs")
    assert gateway.end(signal.SIGINT) == 1, gateway.stderr
    words = "red may still be moving: red is unreachable ("
    assert words in gateway.stderr, "the one before may have left it driving"


def test_gateway_run_imports_no_unneeded_packages(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    code = (
        "import sys\nfrom gateway.cli import main\n"
        "try:\n    main()\nfinally:\n    import json\n"
        "    print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    )
    tcp_car.obey(PI_REPORT)
    process = fleet.start("-c", code, "run", "--car", "red", "--link", tcp_car.link, "--platform", "raspberry_pi")
    fleet.ready()
    assert process.end() == 0
    loaded = set(process.line())
    assert {"gateway", "zenoh", "google"} <= loaded
    assert not loaded & {"click", "pydantic", "rich", "mcap", "rerun", "yaml", "fleet", "serial", "numpy", "pyarrow"}


def test_gateway_ends_with_its_parent(fleet: FleetProcesses) -> None:
    """If the supervisor is killed, its gateways stop their cars and end."""
    sim, (link,) = fleet.simulate("red:arduino:pty")
    arguments = ["-m", "gateway.cli", "run", "--car", "red", "--link", link, "--platform", "arduino"]
    starter = fleet.start(
        "-c",
        "import os, subprocess, sys; "
        f"child = subprocess.Popen([sys.executable, *{arguments!r}, '--parent', str(os.getpid())]); "
        "print(child.pid, flush=True); child.wait()",
    )
    gateway = starter.line()
    fleet.ready()
    assert fleet.ask("drive", motion="forward", duration_s=10)["status"] in TAKEN
    wait_for(lambda: driving(sim), "the car drives")
    starter.popen.kill()
    wait_for(lambda: not driving(sim), "the car stands")
    wait_for(lambda: not fleet.bus.tokens("fleet/red"), f"gateway {gateway} has ended")


def test_interrupted_mode_command_opens_no_mode(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    """A car that says nothing is stopped for 14 s before a mode. Who has given up does not watch it any more."""
    events: list[Any] = []
    fleet.bus.subscribe("fleet/red/event/command", lambda sample: events.append(sample.message()))
    fleet.gateway(tcp_car.link)
    wait_for(lambda: tcp_car.received, "the gateway stops the car")
    command = fleet.start("-m", "fleet.cli", "mode", "red", "tracking", "--connect", fleet.endpoint)
    wait_for(lambda: [each.phase for each in events] == ["asked", "queued"], "the mode waits for the stop")
    command.popen.send_signal(signal.SIGINT)
    assert command.wait() == 130
    ended = [each for each in events if each.id == events[0].id][-1]
    assert (ended.phase, ended.words.partition(" by ")[0]) == ("superseded", "mode manual")
