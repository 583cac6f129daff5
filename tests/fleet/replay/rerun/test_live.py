"""`fleet view` shows the messages of the bus, listens on loopback only, and leaves no process behind."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import rerun as rr
import rerun.chunk as rrc
import zenoh
from click.testing import CliRunner

from fleet.commands.view import view
from fleet.recording.left_out import LeftOutCause
from fleet.replay.rerun import live, rrd_export
from fleet.replay.rerun.live import Live
from fleet.replay.rerun.viewer import Viewer, free_port
from schemas.bus import Bus, reply_message, router_config
from schemas.colors import car_color
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import PROTOBUF, TOPICS, Qos
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess, freeze, wait_for


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[FleetProcesses]:
    directory = tmp_path / "processes"
    directory.mkdir()
    made = FleetProcesses(free_endpoint(), directory)
    try:
        yield made
    finally:
        made.close()


def publish(bus: Bus, car: str, distances: range) -> None:
    publisher = bus.publisher(f"fleet/{car}/sensor/range", TOPICS["sensor/range"], car)
    for distance in distances:
        publisher.put(pb.Range(range_m=distance), time.time_ns())


def start_view(fleet: FleetProcesses, *arguments: str) -> GatewayProcess:
    return fleet.start("-m", "fleet.cli", "view", *arguments)


@contextmanager
def following_of(bus: Bus, sink: Callable[[rr.RecordingStream], None]) -> Iterator[Live]:
    """Follow the fleet. A failed assertion leaves no thread and no directory to the next test."""
    following = Live(bus, "fleet", sink)
    finished = False
    try:
        following.start()
        yield following
        finished = True
    finally:
        following.close(send=finished)


def ended(program: psutil.Process) -> bool:
    """Return True if the process has ended or is a zombie."""
    try:
        return not program.is_running() or program.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def viewers(process: GatewayProcess) -> list[psutil.Process]:
    """Return the processes of Rerun below a process."""
    below = psutil.Process(process.pid).children(recursive=True)
    return [each for each in below if each.name().startswith("rerun")]


def test_cars_have_the_colors_of_the_running_fleet(tmp_path: Path) -> None:
    key = "fleet/@supervisor/status"

    def answer(query: zenoh.Query) -> bool:
        reply_message(query, key, pb.Supervision(colors={"red": "#010203", "blue": "no color"}), as_json=False)
        return True

    endpoint = free_endpoint()
    with zenoh.open(router_config(endpoint)), Bus.open(endpoint) as bus:
        bus.queryable(key, answer)
        with following_of(bus, lambda recording: recording.save(tmp_path / "out.rrd")) as following:
            assert following._drawing.color("red", 0) == (1, 2, 3)
            assert following._drawing.color("blue", 0) == car_color("blue", 0), "what is no color changes nothing"


def test_view_writes_all_bus_messages_to_rrd(fleet: FleetProcesses, tmp_path: Path) -> None:
    out = tmp_path / "now.rrd"
    with Bus.open(fleet.endpoint) as bus, following_of(bus, lambda recording: recording.save(out)) as following:
        publish(fleet.bus, "red", range(50))
        sent = 0
        deadline = time.monotonic() + PATIENCE_S
        while sent < 50 and time.monotonic() < deadline:
            sent += following.step()
        publish(fleet.bus, "blue", range(20))
        wait_for(lambda: following.step() or following.sent == 70, "all is sent")
        while following.sent < 70:
            following.step()
    assert following.cars == ("blue", "red")
    assert following.dropped == 0
    assert rrd_export.rows(out) == {"fleet/red/sensor/range": 50, "fleet/blue/sensor/range": 20}
    reader = rrc.RrdReader(out)
    (layout,) = {each.application_id for each in reader.blueprints()}
    assert layout == rrd_export.APPLICATION


def test_live_view_counts_strays_and_junk(fleet: FleetProcesses, tmp_path: Path) -> None:
    out = tmp_path / "now.rrd"
    link, log = "fleet/red/state/link", "fleet/red/event/log"
    with Bus.open(fleet.endpoint) as bus, following_of(bus, lambda recording: recording.save(out)) as following:

        def put(key: str, payload: bytes, name: str, count: int = 1) -> None:
            for _ in range(count):
                bus.put_again(key, payload, f"{PROTOBUF};{name}" if name else "application/json", 0, Qos.READING)

        # Rerun chooses a schema at random: one batch would prove nothing.
        for number in range(1, 7):
            put(link, pb.Link(state="online").SerializeToString(), "fleet.v1.Link", 10)
            put(link, pb.Range(car="red", range_m=1).SerializeToString(), "fleet.v1.Range")
            put(link, b"{}", "")
            put(link, b"\xff", "fleet.v1.Link")
            put(log, b"\x10\x4d", "foxglove.Log")  # a level without a name, on which Rerun aborts
            given = 14 * number
            wait_for(lambda: following.step() or following.sent + following.left_out.total == given, "all is counted")  # noqa: B023
    assert following.left_out.counts == {
        (link, LeftOutCause.OTHER_TYPE): 6,
        (link, LeftOutCause.NOT_PROTOBUF): 6,
        (link, LeftOutCause.UNREADABLE): 6,
        (log, LeftOutCause.UNKNOWN_ENUM): 6,
    }
    assert rrd_export.rows(out) == {link: 60}


def test_plan_from_before_is_asked_for(fleet: FleetProcesses, tmp_path: Path) -> None:
    from schemas.bus import reply_value

    topic = TOPICS["@coordinator/plan"]
    plan = pb.Plan(text="red: tracking\n", version="1").SerializeToString()

    def answer(query: object) -> None:
        with query:  # type: ignore[attr-defined]
            reply_value(query, "fleet/@coordinator/plan", plan, topic)  # type: ignore[arg-type]

    fleet.bus.queryable("fleet/@coordinator/plan", answer)
    out = tmp_path / "now.rrd"
    with Bus.open(fleet.endpoint) as bus:
        wait_for(lambda: list(bus.query("fleet/@coordinator/plan")), "the hub knows who has the plan")
        with following_of(bus, lambda recording: recording.save(out)):
            pass
    assert rrd_export.rows(out) == {"fleet/@coordinator/plan": 1}


def test_view_counts_messages_dropped_from_full_queue(
    fleet: FleetProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "MAX_WAITING_MESSAGES", 10)
    out = tmp_path / "now.rrd"
    with Bus.open(fleet.endpoint) as bus, following_of(bus, lambda recording: recording.save(out)) as following:
        publish(fleet.bus, "red", range(100))
        wait_for(lambda: following.dropped == 90, "90 find no room")
    assert following.sent == 10


def test_page_on_loopback_that_goes_with_the_command(fleet: FleetProcesses) -> None:
    process = start_view(fleet, "--web")
    publish(fleet.bus, "red", range(5))
    page = process._lines.get(timeout=PATIENCE_S).strip()
    assert page.startswith("http://127.0.0.1:")
    (viewer,) = viewers(process)

    def listens() -> list[Any]:
        return [each for each in viewer.net_connections() if each.status == psutil.CONN_LISTEN]

    listening = wait_for(lambda: len(found := listens()) == 2 and found, "it takes data, too")
    assert {each.laddr.ip for each in listening} == {"127.0.0.1"}
    assert "--memory-limit" in viewer.cmdline()
    assert "--server-memory-limit" in viewer.cmdline()
    assert process.end(signal.SIGINT) == 0
    wait_for(lambda: ended(viewer), "the viewer has ended")


@pytest.mark.parametrize("who", ["the command", "the guard", "the viewer"])
def test_killed_it_leaves_no_viewer(fleet: FleetProcesses, who: str) -> None:
    process = start_view(fleet, "--web")
    process._lines.get(timeout=PATIENCE_S)
    (viewer,) = viewers(process)
    victim = {"the command": process.pid, "the guard": viewer.ppid(), "the viewer": viewer.pid}[who]
    os.kill(victim, signal.SIGKILL)
    process.wait()
    wait_for(lambda: ended(viewer), "the viewer has ended")


def test_hung_viewer_blocks_nothing_and_takes_no_memory(fleet: FleetProcesses, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MAX_WAITING_MESSAGES", 500)
    port, page = free_port(), free_port()
    with Viewer("--serve-web", "--port", str(port), "--web-viewer-port", str(page)) as viewer:
        viewer.wait_until_it_listens(port)
        with (
            Bus.open(fleet.endpoint) as bus,
            following_of(bus, lambda to: to.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")) as following,
        ):
            publish(fleet.bus, "red", range(10))
            wait_for(lambda: following.step() >= 0 and following.sent == 10, "the viewer takes what there is")
            freeze(viewer.pid)
            try:

                def stalled() -> bool:
                    publish(fleet.bus, "red", range(1000))
                    return len(following._queue) == 500 and following.step() == 0

                def more_dropped() -> bool:
                    publish(fleet.bus, "red", range(1000))  # Zenoh may drop some of them under load
                    return following.dropped > dropped + 2000

                # A running viewer may take longer than this to acknowledge its data, so only a stopped one gets so
                # little time.
                with monkeypatch.context() as hurried:
                    hurried.setattr(live, "VIEWER_FLUSH_TIMEOUT_S", 0.2)
                    wait_for(stalled, "the buffers to the viewer are full, and so is the queue")
                    dropped = following.dropped
                    wait_for(more_dropped, "further messages are dropped")
                    assert len(following._queue) == 500
            finally:
                os.kill(viewer.pid, signal.SIGCONT)
            wait_for(lambda: following.step() == 500, "it sends the queue when the viewer goes on")


def test_bad_input_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    endpoint = free_endpoint()
    for arguments, code, words in (
        ([], 1, "--web serves it as a page, --save out.rrd writes a file"),
        (["--web", "--save", "x.rrd"], 2, "exclude each other"),
        (["--save", "x.txt"], 2, "name it x.rrd"),
        (["--web", "--memory", "much"], 2, "--memory much is not allowed"),
        (["--web", "--connect", endpoint], 1, f"(Tried {endpoint}; "),
        (["--save", str(tmp_path / "none" / "x.rrd"), "--connect", endpoint], 2, "there is no directory"),
        (["--web", "--fleet", "No"], 2, "fleet name 'No' is not allowed"),
        (["--web", "--for", "0"], 2, "--for"),
    ):
        result = CliRunner().invoke(view, arguments)
        assert result.exit_code == code, (arguments, result.stderr)
        assert words in result.stderr.replace("\n", " "), arguments


def test_viewer_that_cannot_start_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        with Viewer("--serve-web", "--port", str(free_port()), "--web-viewer-port", port) as viewer:
            assert viewer.wait(PATIENCE_S)
            assert viewer.last_error != "it printed nothing"


def test_guard_ends_its_program_with_its_input() -> None:
    guard = subprocess.Popen(
        [sys.executable, "-m", "schemas.process.parent_guard", "sleep", "600"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert guard.stdin is not None
    assert guard.stdout is not None
    program = psutil.Process(int(guard.stdout.readline()))
    guard.stdin.close()
    guard.wait(PATIENCE_S)
    guard.stdout.close()
    assert not program.is_running()
