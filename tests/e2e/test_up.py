"""`fleet up` with real processes: it restarts crashed and hanging processes, not absent cars, and ends in order."""

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet.client.supervision import ask_status
from fleet.recording.reading.session import Session
from fleet.recording.tools.verify import verify
from schemas import bus, keys
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.disk import MAY_MOUNT, Disk, disk
from tests.support.ports import free_endpoint, free_port
from tests.support.processes import PATIENCE_S, TAKEN, FleetProcesses, driving, freeze, wait_for
from tests.support.soaks import only_in_soak
from tests.support.text_parts import has_parts
from tests.support.up import Up, fleet_command

IN_ITS_PLACE_S = 9.5
"""Maximum time until a new gateway stops the car of a hanging one, which is killed after 7 s.

The car has no dead-man timer, so only a gateway stops it."""
STARTS_S = 10.0
"""Time that the start of a process may add on a machine that runs other tests."""


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """Start two simulated cars without a file."""
    port = free_port()
    page = ("--console-port", str(port))
    with Up(tmp_path_factory.mktemp("up"), free_endpoint(), "--sim", "2", *page) as started:
        words = started.until("ready", "@supervisor", "All 2 cars are ready: red, green. Recording to ")["words"]
        assert words.endswith(f"{started.status().session}. Console: http://127.0.0.1:{port}")
        assert get_page(port) == 200
        yield started


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """Start two simulated cars of a file, with a plan (`_job`)."""
    directory = tmp_path_factory.mktemp("job")
    with Up(directory, free_endpoint(), str(_job(directory)), "--no-record") as started:
        yield started


def get_page(port: int) -> int:
    """Return the HTTP status of the console's page."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
        return int(answer.status)


@pytest.fixture
def job(jobs: Up) -> Up:
    """Restore files and plan of the test before."""
    jobs.running("@coordinator")
    _job(jobs.directory)
    restored = wait_for(lambda: (done := jobs.fleet("reload")).returncode == 0 and done, "reload")
    assert restored.returncode == 0, restored.stderr
    for car, mode in (("ann", "tracking"), ("bob", "light_seeking")):
        wait_for(lambda car=car, mode=mode: _asked(jobs, car) == mode, f"{car} does its role")
    return jobs


# The hub comes last: gateways may start one in its place, and ours then ends again.
@pytest.mark.parametrize("name", ["@recorder", "@simulator", "@console", "red", "@hub"])
def test_up_restarts_only_the_killed_process(up: Up, name: str) -> None:
    before = {each.name: each.pid for each in up.processes()}
    os.kill(up.running(name), signal.SIGKILL)
    up.running(name, but=before[name])
    state = up.state(name)
    assert state.words.endswith(" signal 9") or state.state == "elsewhere"
    after = {each.name: each.pid for each in up.processes()}
    assert {other for other in before if other != name and before[other] != after[other]} == set()
    for car in ("red", "green"):
        up.ready(car)


@pytest.mark.parametrize("name", ["@simulator", *only_in_soak(("green", "@recorder", "@console"))])
def test_up_kills_and_restarts_hung_process(up: Up, name: str) -> None:
    pid = up.running(name)
    freeze(pid)
    wait_for(lambda: not _exists(pid), f"{name} is killed")
    up.running(name, but=pid)
    assert up.state(name).words.startswith("hung: ")
    for car in ("red", "green"):
        up.ready(car)


@pytest.mark.parametrize("token_is_gone", [True, False])
def test_stop_all_reaches_successor_of_hung_gateway(up: Up, token_is_gone: bool) -> None:
    """Its token ends after 2 s, and the supervisor replaces it after 4 s. A stop in between must reach the car."""
    pid = up.running("green")
    freeze(pid)
    if token_is_gone:
        wait_for(lambda: not up.bus.tokens(keys.car_token("fleet", "green")), "its token is gone")
    done = up.fleet("stop")
    # The new gateway may not have opened the link yet. It stops the car after that.
    ended = re.search(
        r"^green: (stopped|stop sent|NOT STOPPED: .*\[link_down\])", done.stdout + done.stderr, re.MULTILINE
    )
    assert ended, done.stdout + done.stderr
    up.running("green", but=pid)
    for car in ("red", "green"):
        assert up.get(f"{car}/state/safety").HasField("hold"), f"{car} is on hold"
    assert up.fleet("resume", "red", "green").returncode == 0


def test_hung_hub_is_replaced(tmp_path: Path) -> None:
    with Up(tmp_path, free_endpoint(), "--sim", "1", "--no-record") as started:
        started.ready("red")
        hub, red = started.running("@hub"), started.running("red")
        freeze(hub)
        wait_for(lambda: not _exists(hub), "it is killed")
        started.running("@hub", but=hub)
        started.ready("red")
        assert started.running("red") == red


def test_one_that_sleeps_itself_blames_nobody(up: Up) -> None:
    before = {each.name: up.running(each.name) for each in up.processes()}
    freeze(up.process.pid)
    try:
        began = time.monotonic()
        seen: list[object] = []
        up.bus.subscribe("fleet/*/state/health", seen.append)
        wait_for(lambda: time.monotonic() - began > 6 and seen, "the cars go on")
    finally:
        os.kill(up.process.pid, signal.SIGCONT)
    wait_for(lambda: up.status() is not None, "it answers again")
    assert {each.name: up.running(each.name) for each in up.processes()} == before


def test_second_one_refuses_and_names_the_first(up: Up) -> None:
    for more in ((), ("--detach",)):
        second = up.fleet("up", "--sim", "1", "--no-record", *more)
        assert second.returncode == 1
        assert f": process {up.process.pid} on " in second.stderr
        assert second.stderr.count("\n") == 1


def test_status_and_logs_say_what_runs(up: Up) -> None:
    ready = up.fleet("wait", "--ready", "--timeout", "60s")
    assert ready.returncode == 0, ready.stderr
    first, header, *cars = up.fleet("status").stdout.splitlines()
    assert re.match(r"the fleet \(simulated cars\): running for \d:\d\d:\d\d, recording to ", first)
    assert header.startswith("CAR ")
    assert [line.split()[0] for line in cars] == ["green", "red"]
    assert f"process {up.running('red')}" in up.fleet("status", "--processes").stdout
    told = json.loads(up.fleet("status", "--json").stdout)
    assert {"@hub", "@recorder", "@simulator", "@console", "red", "green"} == {
        each["name"] for each in told["processes"]
    }
    assert "[link_open]" in up.fleet("logs", "red").stdout
    assert " simulator | {" in up.fleet("logs", "simulator").stdout
    lines = [json.loads(line) for line in up.fleet("logs", "red", "--json").stdout.splitlines()]
    assert {each["name"] for each in lines} == {"red"}
    assert any(each["line"].endswith("[link_open]") for each in lines)
    assert [each["time"] for each in lines] == sorted(each["time"] for each in lines if each["time"].endswith("Z"))
    wrong = up.fleet("logs", "gren")
    assert wrong.returncode == 2
    assert " mean green?" in wrong.stderr


def test_status_names_the_session_that_is_recorded_now(up: Up) -> None:
    """It named the first one, also while nothing was recorded, and while the next one was."""
    first = up.fleet("record", "stop")
    assert first.returncode == 0, first.stderr
    wait_for(lambda: up.status().session == "", "nothing is recorded")
    assert up.fleet("status").stdout.splitlines()[0].endswith(", not recording")
    started = up.fleet("record", "start")
    assert started.returncode == 0, started.stderr
    session = wait_for(lambda: up.status().session, "it is recorded again")
    assert f" {session}, " in started.stdout
    assert f" {session}, " not in first.stdout
    assert up.fleet("status").stdout.splitlines()[0].endswith(f", recording to {session}")


@pytest.mark.parametrize("name", ["@recorder", "@console"])
def test_service_that_hangs_is_named_before_it_is_killed(up: Up, name: str) -> None:
    wait_for(lambda: name not in up.status().missing, f"{name} is ready")
    pid = up.running(name)
    freeze(pid)
    try:
        why = wait_for(lambda: up.status().missing.get(name), f"{name} is named")
        assert re.fullmatch(r"it has not answered for \d+ s", why)
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_for(lambda: name not in up.status().missing, f"{name} answers again")
    assert up.running(name) == pid


def test_command_that_is_none_is_refused(up: Up) -> None:
    for verb, payload, words in (("up", "{}", "allowed are down, reload"), ("down", "{", "is not the JSON")):
        selector = f"fleet/@supervisor/@cmd/{verb}?format=json"
        (answer,) = up.bus.query(selector, payload=payload.encode(), timeout_s=PATIENCE_S)
        assert isinstance(answer, bus.Sample)
        told = json.loads(answer.payload)
        assert told["status"] == "rejected"
        assert words in told["words"]


def test_reload_of_simulated_cars_has_nothing_to_change(up: Up) -> None:
    done = up.fleet("reload")
    assert (done.returncode, done.stdout) == (0, "nothing has changed\n")


def test_down_stops_every_car_and_waits(tmp_path: Path) -> None:
    port = free_port()
    with Up(tmp_path, free_endpoint(), "--sim", "2", "--console-port", str(port)) as started:
        for car in ("red", "green"):
            started.ready(car)
        started.running("@console")
        assert started.ask("drive", "red", motion="forward", duration_s=10)["status"] in TAKEN
        done = started.fleet("down")
        assert done.returncode == 0, done.stderr
        ended = [line.partition(",")[0] for line in done.stdout.splitlines()]
        assert ended == ["green: stop sent", "red: stopped"], "green is an STM32 car, which can show nothing"
        assert started.process.wait() == 0
        with pytest.raises(urllib.error.URLError):
            get_page(port)
        closed = started.until("process", "@recorder", "recording closed")
        assert closed["words"].endswith(" 0 lost")
        assert not started.left()
        gone = started.fleet("status")
        assert gone.returncode == 1
        assert "running" in gone.stderr
        assert "is stopped (confirmed)" in started.fleet("logs", "red").stdout


def test_hold_of_earlier_run_is_told_at_start(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    environment = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(tmp_path / "state")}
    try:
        begun = fleet_command("up", "--sim", "1", "--no-record", "--detach", environment=environment)
        assert (begun.returncode, begun.stdout[:13]) == (0, "red is ready."), begun.stderr
        assert "`fleet down`" in begun.stdout
        assert fleet_command("wait", "--ready", environment=environment).stdout == "red is ready.\n"
        assert "| @supervisor: red is ready." in fleet_command("logs", "supervisor", environment=environment).stdout
        with bus.Bus.open(endpoint) as client:
            payload = b'{"sender": "mia", "kind": "person"}'
            (answer,) = client.query("fleet/red/@cmd/stop?format=json", payload=payload, timeout_s=5.0)
            assert isinstance(answer, bus.Sample)
    finally:
        ended = fleet_command("down", environment=environment)
    assert (ended.returncode, ended.stdout) == (0, "red: stopped\n")
    assert "| red: on hold by mia" in fleet_command("logs", "supervisor", environment=environment).stdout
    with Up(tmp_path, endpoint, "--sim", "1", "--no-record") as started:
        said = started.until("hold", "red", "on hold by mia since ")
        assert said["words"].endswith(" `fleet resume red`")
        assert started.fleet("resume", "red").returncode == 0
        assert not started.get("red/state/safety").HasField("hold")


def test_ctrl_c_stops_cars_and_second_one_does_not_hurry(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    environment = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(tmp_path / "state"), "TERM": "xterm"}
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (40, 400))  # wide enough for any path of a session without a line break
    command = [sys.executable, "-m", "fleet.cli", "up", "--sim", "2", "--sessions", str(tmp_path / "sessions")]
    # A session of its own with the PTY as its terminal: a typed Ctrl-C reaches the foreground group.
    program = f"import os, fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv({command[0]!r}, {command!r})"
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        env=os.environ | environment,
    )
    os.close(slave)
    shown = bytearray()
    reader = threading.Thread(target=_read, args=(master, shown))
    reader.start()
    try:
        wait_for(lambda: bus.accepts(endpoint), "it is up")
        with bus.Bus.open(endpoint) as client:
            truths: dict[str, bus.Sample] = {}
            client.subscribe("fleet/*/sim/truth", lambda sample: truths.__setitem__(sample.key.split("/")[1], sample))
            wait_for(lambda: _known(client) == 2, "both cars are in a known state")
            wait_for(lambda: b"red" in shown and b"green" in shown, "the table shows them")
            payload = b'{"motion": "forward", "duration_s": 10}'
            (answer,) = client.query("fleet/red/@cmd/drive?format=json", payload=payload, timeout_s=5.0)
            assert isinstance(answer, bus.Sample)
            wait_for(lambda: "red" in truths and truths["red"].message().motor_left, "red drives")  # type: ignore[attr-defined]
            (status,) = wait_for(lambda: ask_status(client, "fleet"), "it says what runs")
            (waited_for,) = (each.pid for each in status.processes if each.name == "green")
            freeze(waited_for)  # otherwise it may end before the second Ctrl-C
            os.write(master, b"\x03")
            wait_for(lambda: b"Ctrl-C: stopping every car" in shown, "it ends")
            os.write(master, b"\x03")
            wait_for(lambda: b"Ctrl-C: the fleet is ending already, and waits for" in shown, "it has heard it")
            os.kill(waited_for, signal.SIGCONT)
            wait_for(lambda: not truths["red"].message().motor_left, "red stands")  # type: ignore[attr-defined]
            assert process.wait(PATIENCE_S) == 0, shown[-4000:].decode(errors="replace")
            reader.join()
        said = shown.decode()
        assert "red: stopped" in said
        assert "green: stop sent" in said
        assert " 0 lost" in said
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        reader.join()


def test_switched_off_car_delays_nobody_and_is_not_restarted(fleet: FleetProcesses, tmp_path: Path) -> None:
    _, (link,) = fleet.simulate("red:arduino:tcp")
    off = f"tcp://127.0.0.1:{free_port()}"
    file = _file(tmp_path, blue=off, red=link)
    with Up(tmp_path, fleet.endpoint, str(file), "--no-record") as started:
        started.ready("red")
        pid = started.running("blue")
        wait_for(lambda: (state := started.get("blue/state/link")) and state.state == "lost", "blue's gateway tries")
        not_yet = started.fleet("wait", "--ready", "--for", "100ms")
        assert not_yet.returncode == 1
        assert not_yet.stderr.startswith("1 of 2 cars ready. ")
        assert ": blue (" in not_yet.stderr
        assert started.fleet("wait", "--ready", "red").returncode == 0
        late = fleet.start("-m", "gateway.cli", "sim", "--no-truth", "--car", f"blue:arduino:{off}")
        late.line()
        started.ready("blue")
        state = started.state("blue")
        assert (state.pid, state.restarts) == (pid, 0)
        assert started.state("@hub").state == "elsewhere"


def test_killed_its_cars_are_stopped(fleet: FleetProcesses, tmp_path: Path) -> None:
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    with Up(tmp_path, fleet.endpoint, str(_file(tmp_path, red=link))) as started:
        started.ready("red")
        assert started.ask("drive", "red", motion="forward", duration_s=10)["status"] in TAKEN
        wait_for(lambda: driving(sim), "red drives")
        theirs = {each.pid for each in started.processes() if each.HasField("pid")}
        began = time.monotonic()
        started.process.kill()
        wait_for(lambda: not driving(sim), "red is stopped")
        assert time.monotonic() - began < 9.0, "it was stopped, its drive did not end by itself"
        wait_for(lambda: not [pid for pid in theirs if _exists(pid)], "all end")


def test_shutdown_stops_cars_of_hung_or_killed_gateways(fleet: FleetProcesses, tmp_path: Path) -> None:
    sims = {car: fleet.simulate(f"{car}:arduino:tcp") for car in ("red", "green", "blue")}
    file = _file(tmp_path, **{car: link for car, (_, (link,)) in sims.items()})
    with Up(tmp_path, fleet.endpoint, str(file), "--no-record") as started:
        for car in sims:
            started.ready(car)
        for car, (sim, _) in sims.items():
            assert started.ask("drive", car, motion="forward", duration_s=10)["status"] in TAKEN
            wait_for(lambda car=car, sim=sim: driving(sim, car), f"{car} drives")
        hung, killed, lost = (started.running(car) for car in sims)
        freeze(hung)
        os.kill(killed, signal.SIGKILL)
        for pid in (lost, sims["blue"][0].pid):
            os.kill(pid, signal.SIGKILL)
        began = time.monotonic()
        started.process.popen.send_signal(signal.SIGINT)
        for car in ("green", "red"):
            wait_for(lambda car=car: not driving(sims[car][0], car), f"{car} is stopped")
            assert time.monotonic() - began < IN_ITS_PLACE_S + STARTS_S
        for _ in range(2):
            tried = started.until("end", "blue", "A fresh gateway tries to stop the car")
        assert "`fleet down`" in tried["words"]
        started.process.popen.send_signal(signal.SIGINT)
        assert started.process.wait() == 1
        ended = [*started.heard, *map(json.loads, started.process.lines())]
        said = {each["name"]: each["words"] for each in ended if each["what"] == "end"}
        assert (said["red"], said["green"]) == ("stopped", "stopped")
        assert said["blue"].startswith("NOT STOPPED: ")
        assert said["@supervisor"].startswith("NOT STOPPED: blue. ")


def test_unreachable_car_at_shutdown_is_retried_by_fresh_gateways(fleet: FleetProcesses, tmp_path: Path) -> None:
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    with Up(tmp_path, fleet.endpoint, str(_file(tmp_path, red=link)), "--no-record") as started:
        started.ready("red")
        assert started.ask("mode", "red", mode="obstacle_avoidance")["status"] in TAKEN
        wait_for(lambda: driving(sim), "red avoids obstacles")
        sim.say({"car": "red", "fault": "link_drop"})
        started.process.popen.send_signal(signal.SIGINT)
        for _ in range(2):
            tried = started.until("end", "red", "A fresh gateway tries to stop the car")
            assert tried["words"].startswith("NOT STOPPED: ")
        sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
        started.until("end", "red", "stopped")
        assert not driving(sim)
        assert started.process.wait() == 0


def test_fleet_down_names_unstopped_car_and_fails(fleet: FleetProcesses, tmp_path: Path) -> None:
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    with Up(tmp_path, fleet.endpoint, str(_file(tmp_path, red=link)), "--no-record") as started:
        started.ready("red")
        sim.say({"car": "red", "fault": "link_drop"})
        wait_for(lambda: started.get("red/state/link").state == "lost", "its link is gone")
        first = threading.Thread(target=lambda: started.fleet_process("down"))
        first.start()
        started.until("end", "red", "A fresh gateway tries to stop the car")
        second = started.fleet("down")
        first.join()
        assert second.returncode == 1
        assert second.stderr.startswith("red: NOT STOPPED: ")
        assert started.process.wait() == 1


@pytest.mark.parametrize("until", ["@hub", "red", "green"])
def test_terminated_during_start_ends_at_once_in_order(tmp_path: Path, until: str) -> None:
    with Up(tmp_path, free_endpoint(), "--sim", "2", "--no-record") as started:
        started.until("process", until, "started")
        assert started.process.end(signal.SIGINT) == 0
        *_, last = map(json.loads, started.process.lines())
        assert last["name"] == "@supervisor"
        assert "NOT" not in last["words"], "no car was left moving"
        assert not started.left(ours=True)


def test_killed_simulator_leaves_no_stale_path(tmp_path: Path) -> None:
    with Up(tmp_path, free_endpoint(), "--sim", "1", "--no-record") as started:
        started.ready("red")
        (run,) = (tmp_path / "state" / "buses").glob("*/runs/fleet/*")
        assert [each.name for each in run.glob("*.tty")] == ["red.tty"]
        started.kill(started.running("@simulator"))
        started.process.end(signal.SIGINT)
        assert not [each for each in run.glob("*.tty") if each.is_symlink()]


def test_removed_car_is_stopped_though_its_gateway_hangs(fleet: FleetProcesses, tmp_path: Path) -> None:
    sim, links = fleet.simulate("red:arduino:tcp", "green:arduino:tcp")
    file = _file(tmp_path, red=links[0], green=links[1])
    with Up(tmp_path, fleet.endpoint, str(file), "--no-record") as started:
        started.ready("green")
        assert started.ask("drive", "green", motion="forward", duration_s=10)["status"] in TAKEN
        wait_for(lambda: driving(sim, "green"), "green drives")
        freeze(started.running("green"))
        file.write_text(_text(red=links[0]))
        assert started.fleet("reload").stdout == "green is removed\n"
        began = time.monotonic()
        wait_for(lambda: not driving(sim, "green"), "green is stopped")
        assert time.monotonic() - began < IN_ITS_PLACE_S + STARTS_S
        started.until("end", "green", "stopped")
        wait_for(lambda: started.state("green") is None, "its gateway has ended")


def test_reload_applies_what_it_can_and_bad_file_changes_nothing(fleet: FleetProcesses, tmp_path: Path) -> None:
    _, links = fleet.simulate("red:arduino:tcp", "green:arduino:tcp", "blue:arduino:tcp")
    red, green, blue = links
    file = _file(tmp_path, red=red, green=green)
    with Up(tmp_path, fleet.endpoint, str(file), "--no-record") as started:
        before = {car: started.running(car) for car in ("red", "green")}
        started.ready("green")

        file.write_text("cars:\n  red: {lnk: nowhere}\n  blue: {link: 7}\n")
        refused = started.fleet("reload")
        assert refused.returncode == 2
        assert refused.stderr.endswith("Nothing was changed.\n")
        assert "cars.red.lnk" in refused.stderr
        assert "cars.blue.link" in refused.stderr
        assert {car: started.running(car) for car in before} == before

        file.write_text(_text(red=red, blue=blue).replace("cars:", "name: lab\ncars:"))
        done = started.fleet("reload")
        assert (done.returncode, done.stdout) == (1, "")
        assert [line.split(":")[0] for line in done.stderr.splitlines()[:2]] == ["blue is added", "green is removed"]
        assert "the fleet's name" in done.stderr
        assert f"`fleet down`, `fleet up {file}`" in done.stderr, "without its name, it would start another file"
        started.ready("blue")
        wait_for(lambda: started.state("green") is None, "green's gateway has ended")
        assert started.running("red") == before["red"]

        file.write_text(_text(red=red, blue=blue).replace("blue: {", "blue: {limits: {longest_drive_s: 3}, "))
        pid = started.running("blue")
        assert "blue is restarted" in started.fleet("reload").stdout
        started.running("blue", but=pid)
        started.ready("blue")
        assert started.state("blue").restarts == 0, "somebody wanted it"
        assert "started again" not in started.fleet("doctor").stdout
        answer = started.ask("drive", "blue", motion="forward", duration_s=4)
        assert answer["reason"] == "bad_value"
        assert started.running("red") == before["red"]


def test_coordinator_takes_new_plan_and_refuses_bad_one(job: Up) -> None:
    plan = job.directory / "plan.yaml"
    pid = job.running("@coordinator")
    plan.write_text("roles: {follow: {mode: trakking}, seek: {mode: light_seeking}}\n")
    refused = job.fleet("reload")
    assert refused.returncode == 2
    assert "trakking" in refused.stderr
    plan.write_text("roles: {follow: {mode: light_seeking}, seek: {mode: light_seeking}}\n")
    assert "plan has changed" in job.fleet("reload").stdout
    wait_for(lambda: _asked(job, "ann") == "light_seeking", "ann seeks light")
    assert job.running("@coordinator") == pid
    job.kill(pid)
    assert job.running("@coordinator", but=pid)
    answer = job.get("@coordinator/plan")
    assert answer is None or "follow: {mode: light_seeking}" in answer.text, "the one after it has the new plan, too"


def test_coordinator_keeps_accepted_plan_when_files_change(job: Up) -> None:
    pid = job.running("@coordinator")
    (job.directory / "fleet.yaml").write_text("cars: [\n")
    (job.directory / "plan.yaml").unlink()
    assert job.fleet("reload").stderr.endswith("Nothing was changed.\n")
    job.kill(pid)
    assert job.running("@coordinator", but=pid)


def test_simulated_cars_that_have_no_link_yet_do_a_plan(tmp_path: Path) -> None:
    with Up(tmp_path, free_endpoint(), str(_job(tmp_path, link="")), "--sim", "2", "--no-record") as started:
        for car, mode in (("ann", "tracking"), ("bob", "light_seeking")):
            wait_for(lambda car=car, mode=mode: _asked(started, car) == mode, f"{car} is told its role")


def test_recording_has_the_plan_from_its_first_message(tmp_path: Path) -> None:
    with Up(tmp_path, free_endpoint(), str(_job(tmp_path, link="")), "--sim", "2") as started:
        started.until("process", "@coordinator", "started")
        recorder = [each["words"] for each in started.heard if each["name"] == "@recorder"]
        assert any("recording to" in words for words in recorder), f"the recorder has only said: {recorder}"
        wait_for(lambda: started.get("@coordinator/assignment"), "the coordinator has decided")
        assert started.fleet("down").returncode == 0
    first = next(Session(str(next(started.out.glob("*-fleet")))).messages("@coordinator/plan"))
    assert first.sequence == 1


def test_reload_tells_the_coordinator_what_the_cars_may_do_now(job: Up) -> None:
    _job(job.directory, ann="seek", bob="follow")
    told = job.fleet("reload").stdout
    assert [line.split(":")[0] for line in told.splitlines()] == ["ann", "bob"]
    wait_for(lambda: _asked(job, "bob") == "tracking", "bob follows")
    assert job.fleet("reload").stdout == "nothing has changed\n"


def test_reload_restores_a_plan_that_was_replaced_over_the_bus(job: Up) -> None:
    pid = _given_another_job(job)
    wait_for(lambda: _asked(job, "ann") == "obstacle_avoidance", "ann does as the plan over the bus says")
    told = job.fleet("reload").stdout
    assert "replaces plan " in told
    wait_for(lambda: _asked(job, "ann") == "tracking", "ann follows again")
    assert job.running("@coordinator") == pid
    assert job.fleet("reload").stdout == "nothing has changed\n"


def test_plan_from_bus_outlives_its_coordinator(job: Up) -> None:
    pid = _given_another_job(job)
    job.until("process", "@coordinator", "came over the bus. It is in force until `fleet reload`.")
    job.kill(pid)
    assert job.running("@coordinator", but=pid)
    plan = wait_for(lambda: job.get("@coordinator/plan"), "a coordinator answers")
    assert plan.text == OTHER_JOB
    wait_for(lambda: _asked(job, "ann") == "obstacle_avoidance", "ann does as the plan over the bus says")


def test_reload_on_a_full_disk_changes_nothing(job: Up) -> None:
    """The run's directory is moved away, so that no file can be written, not even by root."""
    file = job.directory / "fleet.yaml"
    (run,) = (job.directory / "state" / "buses").glob("*/runs/fleet/*")
    run.rename(run.with_name("away"))
    try:
        text = file.read_text()
        file.write_text(text + "  eve: {link: tcp://127.0.0.1:9}\n")
        (job.directory / "plan.yaml").write_text(OTHER_JOB)
        refused = job.fleet("reload")
        assert refused.returncode == 2
        assert refused.stderr.startswith("nothing was changed: ")
        assert job.state("eve") is None
    finally:
        run.with_name("away").rename(run)
    done = job.fleet("reload")
    assert "eve is added" in done.stdout
    assert "plan has changed" in done.stdout
    wait_for(lambda: _asked(job, "ann") == "obstacle_avoidance", "ann does as the new plan says")


def test_unreachable_plan_is_refused(job: Up) -> None:
    bad = "roles: {follow: {mode: tracking, cars: [eve]}, seek: {mode: light_seeking}}\n"
    (job.directory / "plan.yaml").write_text(bad)
    refused = job.fleet("reload")
    assert refused.returncode == 2
    assert "plan.yaml:1:41: error: car eve: " in refused.stderr
    assert refused.stderr.endswith("\nNothing was changed.\n")
    second = fleet_command("up", str(job.directory / "fleet.yaml"), environment={})
    assert second.returncode == 2
    assert "plan.yaml:1:41: error: car eve: " in second.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "no fleet.yaml here. `fleet init`"),
        (("--sim", "0"), "--sim: 0 … 1"),
        (("none.yaml",), "none.yaml"),
        (("--sim", "1", "--plan", "none.yaml"), "none.yaml: error: … file"),
        (("--sim", "1", "--fleet", "Über"), "fleet name"),
        (("--sim", "1", "--connect", "here"), "endpoint 'here' "),
        (("--sim", "1", "--connect", f"tcp/0.0.0.0:{free_port()}"), "accept it with --insecure-lan"),
    ],
)
def test_wrong_use_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = fleet_command("up", *arguments, environment={})
    assert done.returncode == 2
    assert has_parts(done.stderr, words)
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_unwritable_recording_place_is_refused_at_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    done = fleet_command("up", "--sim", "1", "--sessions", str(tmp_path / "file" / "sessions"), environment={})
    assert done.returncode == 1
    assert str(tmp_path / "file" / "sessions") in done.stderr
    assert "--no-record" in done.stderr


def test_paused_recording_is_told_by_up_status_doctor_and_down(tmp_path: Path) -> None:
    """The status is what the recorder of a full disk publishes (tests/fleet/recording/scenarios/test_disk.py)."""
    with Up(tmp_path, free_endpoint(), "--sim", "1", "--no-record") as up:
        up.until("ready", "@supervisor", "red is ready")
        recorder = up.bus.publisher("fleet/@recorder/status", TOPICS["@recorder/status"], keys.RECORDER)

        def publish(state: str, error: str = "", **drops: int) -> None:
            recorder.put(pb.Recording(state=state, error=error, drops=drops), time.time_ns())

        publish("full", "0.1 MB are left")
        up.until("process", "@recorder", "0.1 MB are left")
        assert "0.1 MB are left" in up.status().unrecorded
        status = up.fleet("status")
        assert "0.1 MB are left" in status.stdout
        (odd,) = json.loads(up.fleet("doctor", "red", "--json").stdout)["findings"]
        assert odd["code"] == "not_recorded"
        assert up.fleet("drive", "red", "forward", "--for", "200ms").returncode == 0, "the cars drive on"
        publish("recording")
        up.until("process", "@recorder", "records again")
        assert up.status().unrecorded == ""
        publish("failed", "it was unplugged")
        up.until("process", "@recorder", "it was unplugged")
        publish("recording", red=2)
        up.until("process", "@recorder", "records again")
        down = up.fleet("down")
        assert down.returncode == 1, "it records again, but not everything was recorded"
        assert "red: stopped" in down.stdout
        assert "dropped 2 messages" in down.stderr
        assert up.process.wait() == 1


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[Disk]:
    """Yield a disk that takes the sessions of a `fleet up` in this directory."""
    with disk("full for a while", place) as there:
        there.root.mkdir()
        (place / "sessions").symlink_to(there.root)
        yield there


@pytest.mark.xdist_group("disk")
@pytest.mark.skipif(not MAY_MOUNT, reason="may not mount a disk of its own")
def test_temporarily_full_disk_loses_nothing_and_all_agree(tmp_path: Path) -> None:
    with small_disk(tmp_path) as there, Up(tmp_path, free_endpoint(), "--sim", "1") as up:
        up.until("ready", "@supervisor", "red is ready")
        session = Path(up.status().session)

        def says() -> list[bool]:
            """Return for each place that tells it whether it says that the car is recorded."""
            wait_for(lambda: bool(up.status().unrecorded) is (up.get("@recorder/status").state == "full"), "the same")
            return [
                "not recorded" not in up.fleet("status").stdout,
                up.fleet("record", "status").stdout.startswith("recording: "),
                json.loads(up.fleet("doctor", "red", "--json").stdout)["findings"] == [],
                up.fleet("mark", "here").returncode == 0,
            ]

        assert says() == [True] * 4
        there.fill()
        up.until("process", "@recorder", "NOT RECORDED")
        assert says() == [False] * 4
        waited = up.get("@recorder/status")
        assert waited.warning == "", "one state: what it was before is no second one"
        there.free()
        up.until("process", "@recorder", "records again")
        assert says() == [True] * 4
        assert up.fleet("down").returncode == 0
        up.process.wait()
        verdict = verify(Session(session))
        assert verdict.whole, list(verdict.words())
        assert [mark["text"] for mark in json.loads((session / "session.json").read_text())["marks"]] == ["here"] * 3


def _file(directory: Path, **links: str) -> Path:
    path = directory / "fleet.yaml"
    path.write_text(_text(**links))
    return path


def _text(**links: str) -> str:
    return "cars:\n" + "".join(f"  {car}: {{link: '{link}', platform: arduino}}\n" for car, link in links.items())


def _job(directory: Path, link: str = "link: sim, ", ann: str = "follow", bob: str = "seek") -> Path:
    """Write a file of two simulated cars and a plan, with the role that each car may take."""
    (directory / "plan.yaml").write_text("roles: {follow: {mode: tracking}, seek: {mode: light_seeking}}\n")
    path = directory / "fleet.yaml"
    cars = "".join(f"  {car}: {{{link}roles: [{role}]}}\n" for car, role in (("ann", ann), ("bob", bob)))
    path.write_text(f"plan: plan.yaml\ndefaults: {{platform: arduino}}\ncars:\n{cars}")
    return path


OTHER_JOB = "roles: {follow: {mode: obstacle_avoidance}, seek: {mode: light_seeking}}\n"


def _given_another_job(started: Up) -> int:
    """Set another plan over the bus. Return the process id of the coordinator."""
    pid = started.running("@coordinator")
    wait_for(lambda: _asked(started, "ann") == "tracking", "ann follows")
    (answer,) = started.bus.query("fleet/@coordinator/@cmd/plan", payload=OTHER_JOB.encode(), timeout_s=5.0)
    assert isinstance(answer, bus.Sample)
    return pid


def _asked(started: Up, car: str) -> str:
    mode = started.get(f"{car}/state/mode")
    return "" if mode is None else str(mode.asked)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _known(client: bus.Bus) -> int:
    """Return the number of cars that were brought to a known state."""
    answers = [each for each in client.query("fleet/*/state/safety") if isinstance(each, bus.Sample)]
    return sum(answer.message().motors == "off" for answer in answers)  # type: ignore[attr-defined]


def _read(master: int, shown: bytearray) -> None:
    while True:
        try:
            data = os.read(master, 4096)
        except OSError:  # the other end has closed
            break
        if not data:
            break
        shown += data
    os.close(master)
