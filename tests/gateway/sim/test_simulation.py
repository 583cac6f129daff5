"""The running simulator: its links, faults that come and go, and the process around it."""

import asyncio
import contextlib
import itertools
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from fleet.examples import EXAMPLES
from gateway.sim.car_spec import parse_cars
from gateway.sim.endpoints import EndpointError, Taken
from gateway.sim.faults import Fault, FaultKind
from gateway.sim.model.car_body import CUT_OFF_V
from gateway.sim.model.faulty_link import Direction
from gateway.sim.model.firmware_base import Firmware
from gateway.sim.model.ir_remote import Button
from gateway.sim.model.raspberry_pi import PI_BOOT_S
from gateway.sim.model.ugv import UgvCar
from gateway.sim.simulation import Simulation
from gateway.sim.truth_publisher import HUB_RETRY_DELAY_S, TruthPublisher
from schemas.bus import Bus, Sample
from tests.gateway.sim.strangers import FAN, MODE00, PATIENCE, RUN, STOP, opening, until
from tests.support.ports import free_endpoint


@pytest.fixture
async def pair(tmp_path: Path) -> AsyncIterator[Simulation]:
    specs = parse_cars([f"red:arduino:pty:{tmp_path / 'red'}", "blue:raspberry_pi:tcp", "green:arduino:tcp"])
    simulation = Simulation(specs, seed=1)
    await simulation.start()
    yield simulation
    await simulation.stop()


def where(simulation: Simulation, name: str) -> tuple[str, int]:
    host, _, port = simulation.cars[name].url.removeprefix("tcp://").rpartition(":")
    return host, int(port)


async def test_pty_is_paced_at_9600_baud(pair: Simulation) -> None:
    car = pair.cars["red"]
    with serial.Serial(car.url.removeprefix("serial://"), timeout=0) as port:
        port.write(FAN)  # while the fan runs, the car sends no reading of its own
        await until(lambda: car.truth.fan, "the fan runs")
        begun = time.monotonic()
        for _ in range(4):
            port.write(RUN + STOP)
        port.write(b"$1,0,0,0,0,0,0,0,0#")
        await until(lambda: len(car.firmware.motor_log) == 10, "all nine frames obeyed, each by itself")  # type: ignore[attr-defined]
        assert time.monotonic() - begun >= 9 * 19 / 960 - 0.005
        log = list(car.firmware.motor_log)  # type: ignore[attr-defined]
        assert all(b[0] - a[0] >= 19 / 960 - 1e-6 for a, b in itertools.pairwise(log[1:]))
        port.write(FAN)
        await until(lambda: not car.truth.fan, "the fan is off")
        port.write(opening(2))
        data = bytearray()
        await until(
            lambda: data.extend(port.read(4096)) or (b"LF" in data[-40:] and car.truth.mode == "tracking"), "tracks"
        )
        begun = time.monotonic()
        assert car.truth.mode == "tracking"  # advances the car to now, so that no due reading counts
        while port.read(4096):
            pass
        data.clear()
        await until(lambda: data.extend(port.read(4096)) or len(data) > 1500, "talks")
        assert time.monotonic() - begun >= 1500 / 960 - 0.2


@pytest.mark.parametrize(("platform", "right"), [("arduino", 9600), ("ugv_rover", 115200)])
async def test_host_at_wrong_baud_rate_understands_no_car(platform: str, right: int, tmp_path: Path) -> None:
    simulation = Simulation(parse_cars([f"red:{platform}:pty:{tmp_path / 'red'}"]))
    await simulation.start()
    car = simulation.cars["red"]
    drive = RUN if platform == "arduino" else b'{"T":1,"L":0.3,"R":0.3}\n'
    data = bytearray()
    with serial.Serial(str(tmp_path / "red"), 57600, timeout=0) as port:
        for _ in range(3):
            port.write(drive)
        await until(lambda: data.extend(port.read(4096)) or len(data) > 100, "noise")
        assert not {b"CSB", b'"T"'} & {bytes(data[at : at + 3]) for at in range(len(data))}
        assert not car.truth.driving
        port.baudrate = right
        port.write(b"\n" + drive)
        data.clear()
        await until(lambda: data.extend(port.read(4096)) or (b"CSB" in data or b'"T":1001' in data), "words")
    await simulation.stop()


async def test_pty_firehose_is_held_back(pair: Simulation) -> None:
    car = pair.cars["red"]
    with serial.Serial(car.url.removeprefix("serial://"), write_timeout=0.2) as port:
        with pytest.raises(serial.SerialTimeoutException):
            await asyncio.to_thread(port.write, b"$4WD,nonsense#" * 20_000)
        assert car.firmware.backlog(asyncio.get_running_loop().time()) < 1000


async def test_dropped_pty_returns_under_its_name(pair: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "red"
    first = path.readlink()
    with serial.Serial(str(path), timeout=5) as port:
        port.write(opening(2))
        await until(lambda: pair.cars["red"].truth.mode == "tracking", "opened")

        def read_on() -> None:
            while True:
                port.read(4096)

        reading = asyncio.create_task(asyncio.to_thread(read_on))
        await pair.inflict(Fault(FaultKind.LINK_DROP, "red"))
        with pytest.raises(serial.SerialException):
            await asyncio.wait_for(reading, PATIENCE)
        assert not path.is_symlink()
    await pair.inflict(Fault(FaultKind.LINK_DROP, "red", for_s=0))
    assert path.readlink() == first or str(path.readlink()).startswith("/dev/")
    with serial.Serial(str(path), timeout=0) as port:
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or b"CSB0,PV8" in data, "still tracking")
        port.write(MODE00)
        await until(lambda: pair.cars["red"].truth.mode == "manual", "hears again")


async def test_pty_reports_new_name_after_link_drop() -> None:
    simulation = Simulation(parse_cars(["red:arduino:pty"]))
    await simulation.start()
    car = simulation.cars["red"]
    named: list[str] = []
    car.on_renamed = lambda moved: named.append(moved.url)
    first = car.url
    with serial.Serial(first.removeprefix("serial://")):  # while open, the system cannot assign the old name again
        await simulation.inflict(Fault(FaultKind.LINK_DROP, for_s=0.05))
        await until(lambda: named, "back")
    assert named == [car.url]
    assert car.url != first
    await simulation.stop()


async def test_tcp_firehose_is_held_back(pair: Simulation) -> None:
    _, writer = await asyncio.open_connection(*where(pair, "green"))
    car = pair.cars["green"]
    writer.write(b"$4WD,nonsense#" * 200_000)
    await until(lambda: car.firmware.backlog(asyncio.get_running_loop().time()) > 128, "arrives")
    for _ in range(20):
        await asyncio.sleep(0.01)
        assert car.firmware.backlog(asyncio.get_running_loop().time()) < 1000
    writer.transport.abort()


async def test_dropped_tcp_link_resets_refuses_and_returns(pair: Simulation) -> None:
    host, port = where(pair, "green")
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(RUN)
    await until(lambda: pair.cars["green"].truth.driving, "drives")
    await pair.inflict(Fault(FaultKind.LINK_DROP, "green"))
    with pytest.raises(ConnectionResetError):
        await asyncio.wait_for(_drain(reader), PATIENCE)
    writer.close()
    with pytest.raises(ConnectionError):
        await asyncio.open_connection(host, port)
    assert pair.cars["green"].truth.driving
    await pair.inflict(Fault(FaultKind.LINK_DROP, "green", for_s=0.2))  # now for a limited time

    async def answers() -> bool:
        try:
            _, again = await asyncio.open_connection(host, port)
        except ConnectionError:
            return False
        again.write(STOP)
        await again.drain()
        again.close()
        return True

    end = time.monotonic() + PATIENCE
    while not await answers():
        assert time.monotonic() < end
        await asyncio.sleep(0.05)
    await until(lambda: not pair.cars["green"].truth.driving, "stops")


async def _drain(reader: asyncio.StreamReader) -> None:
    while await reader.read(4096):
        pass
    raise AssertionError("closed, not reset")


async def driven(simulation: Simulation, car: str) -> tuple[str, int, asyncio.StreamWriter]:
    """Connect to a car over TCP and let it drive. Return where it is, and the connection."""
    host, port = where(simulation, car)
    _, writer = await asyncio.open_connection(host, port)
    writer.write(RUN)
    await until(lambda: simulation.cars[car].truth.driving, "drives")
    return host, port, writer


async def until_open(host: str, port: int, patience_s: float = PATIENCE) -> None:
    """Wait until a port accepts connections. Nothing else tells when it does."""
    end = time.monotonic() + patience_s
    while True:
        with contextlib.suppress(ConnectionError):
            _, writer = await asyncio.open_connection(host, port)
            writer.close()
            return
        assert time.monotonic() < end
        await asyncio.sleep(0.05)


async def test_raspberry_pi_program_dies_with_its_link(pair: Simulation) -> None:
    host, port, writer = await driven(pair, "blue")
    await pair.inflict(Fault(FaultKind.LINK_DROP, "blue", for_s=0.1))
    await until(lambda: not pair.cars["blue"].truth.alive, "dies")
    await pair.inflict(Fault(FaultKind.LINK_DROP, "blue", for_s=0))
    with pytest.raises(ConnectionError):
        await asyncio.open_connection(host, port)
    assert pair.cars["blue"].truth.driving
    await pair.inflict(Fault(FaultKind.BROWNOUT, "blue"))
    assert not pair.cars["blue"].truth.driving

    await until_open(host, port)
    writer.close()


async def test_second_tcp_client_is_sent_away(pair: Simulation) -> None:
    host, port = where(pair, "green")
    _, first = await asyncio.open_connection(host, port)
    reader, second = await asyncio.open_connection(host, port)
    with contextlib.suppress(ConnectionResetError):
        assert await asyncio.wait_for(reader.read(), PATIENCE) == b""
    first.write(RUN)
    await until(lambda: pair.cars["green"].truth.driving, "the first one drives")
    first.close()
    second.close()


async def test_garbage_reaches_the_host_and_the_car(pair: Simulation) -> None:
    with serial.Serial(pair.cars["red"].url.removeprefix("serial://"), timeout=0) as port:
        await pair.inflict(Fault(FaultKind.GARBAGE, "red", bytes=300, ways=(Direction.TO_HOST,)))
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or len(data) >= 300, "noise")
        assert len(set(data)) > 50
        await pair.inflict(Fault(FaultKind.GARBAGE, "red", bytes=50, ways=(Direction.TO_CAR,)))


async def test_endpoint_in_use_is_refused(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(EndpointError, match=rf"car red: cannot listen on 127.0.0.1:{port}"):
            await Simulation(parse_cars(["ok:arduino:pty", f"red:arduino:tcp://127.0.0.1:{port}"])).start()
    (tmp_path / "file").write_text("precious")
    with pytest.raises(EndpointError, match="file is there"):
        await Simulation(parse_cars([f"red:arduino:pty:{tmp_path / 'file'}"])).start()
    assert (tmp_path / "file").read_text() == "precious"
    with pytest.raises(EndpointError, match="No such file"):
        await Simulation(parse_cars([f"red:arduino:pty:{tmp_path / 'nowhere' / 'x'}"])).start()


async def test_symlink_of_killed_simulator_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "red"
    path.symlink_to("/dev/pts/99999")
    simulation = Simulation(parse_cars([f"red:arduino:pty:{path}"]))
    await simulation.start()
    serial.Serial(str(path)).close()
    await simulation.stop()
    assert not path.is_symlink()


async def test_reused_pty_number_keeps_no_stale_symlink(tmp_path: Path) -> None:
    """A killed simulator's terminal is gone, and the system gives its number to the next program."""
    path = tmp_path / "red"
    controller, device = pty.openpty()
    path.symlink_to(os.ttyname(device))
    os.utime(path, (1e9, 1e9), follow_symlinks=False)
    simulation = Simulation(parse_cars([f"red:arduino:pty:{path}"]))
    await simulation.start()
    assert str(path.readlink()) != os.ttyname(device)
    await simulation.stop()
    os.close(device)
    os.close(controller)


async def test_symlink_of_running_simulator_is_refused(pair: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "red"
    first = path.readlink()
    with serial.Serial(str(path)):  # a host that opens the port does not change the owner
        with pytest.raises(Taken, match=f"car blue: {path} leads to {first}, .* in use"):
            await Simulation(parse_cars([f"blue:arduino:pty:{path}"])).start()
        assert path.readlink() == first
    await pair.stop()
    assert not path.is_symlink()


@pytest.mark.parametrize("target", ["/dev/null", "/dev/pts/ptmx", "nowhere"])
def test_foreign_symlink_is_left_alone(target: str, tmp_path: Path) -> None:
    path = tmp_path / "precious"
    path.symlink_to(target)
    command = [sys.executable, "-m", "gateway.sim", "--no-truth", "--car", f"red:arduino:pty:{path}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"gateway sim: car red: {path} leads to {target}: ")
    assert str(path.readlink()) == target


# ---------------------------------------------------------------- the process


class SimProcess:
    def __init__(self, *arguments: str, **more: Any) -> None:
        command = [sys.executable, "-m", "gateway.sim", *arguments]
        more = {"stdin": subprocess.PIPE, **more}
        self.popen = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1, **more
        )

    def line(self) -> dict[str, Any]:
        assert self.popen.stdout is not None
        return json.loads(self.popen.stdout.readline())

    def ask(self, **fields: object) -> dict[str, Any]:
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps(fields) + "\n")
        self.popen.stdin.flush()
        return self.line()

    def end(self) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()
        for stream in (self.popen.stdin, self.popen.stdout, self.popen.stderr):
            if stream is not None:
                stream.close()


@pytest.fixture
def started() -> Iterator[list[SimProcess]]:
    processes: list[SimProcess] = []
    yield processes
    for process in processes:
        process.end()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_simulator_announces_cars_takes_faults_and_ends_clean(
    number: signal.Signals, started: list[SimProcess], tmp_path: Path
) -> None:
    path = tmp_path / "red"
    sim = SimProcess(
        "--car", f"red:arduino:pty:{path}", "--car", "blue:raspberry_pi+arm:tcp", "--no-truth", "--seed", "7"
    )
    started.append(sim)
    assert sim.line() == {"car": "red", "platform": "arduino", "link": f"serial://{path}"}
    blue = sim.line()
    assert (blue["car"], blue["platform"]) == ("blue", "raspberry_pi+arm")
    assert blue["link"].startswith("tcp://127.0.0.1:")
    assert sim.ask(car="red", ask="truth")["mode"] == "manual"
    assert sim.ask(fault="garbage", bytes=10) == {"ok": True, "fault": "garbage", "cars": ["red", "blue"]}
    answer = sim.ask(fault="garbage", car="nobody")
    assert not answer["ok"]
    assert "'nobody'" in answer["error"]
    assert answer["error"].endswith("red, blue")
    assert not sim.ask(fault="melt")["ok"]
    assert "use truth or world" in sim.ask(ask="thruth", car="red")["error"]
    assert "'lamp'" in sim.ask(ask="world", lamp="beacon")["error"]
    assert sim.popen.stdin is not None
    sim.popen.stdin.write("no json\n")
    assert "not JSON" in sim.line()["error"]
    sim.popen.stdin.write("[" * 60_000 + "\n")
    answer = sim.line()
    assert not answer["ok"]
    # Python 3.14 parses JSON of any depth, and misses its end.
    assert ("too deep" if sys.version_info < (3, 14) else "not JSON") in answer["error"]
    assert sim.ask(car="red", fault="link_drop")["ok"]
    assert not path.is_symlink()
    assert sim.ask(car="red", fault="link_drop", for_s=0)["ok"]
    sim.popen.stdin.close()  # the end of stdin does not end the simulator
    with serial.Serial(str(path), timeout=PATIENCE) as port:
        assert port.read_until(b"#").endswith(b"#")
    sim.popen.send_signal(number)
    assert sim.popen.wait(PATIENCE) == 0
    assert not path.is_symlink()
    assert sim.popen.stderr is not None
    assert sim.popen.stderr.read() == ""


@pytest.mark.parametrize("closed", [">&-", "<&-", ">/dev/full", "<&- >&-", ""])
def test_simulated_cars_run_without_standard_streams(closed: str, tmp_path: Path) -> None:
    """An opened file may get the descriptor of a closed stream.

    Without a redirection stdout is a pipe whose reader is gone.
    """
    path = tmp_path / "red"
    sim = [sys.executable, "-m", "gateway.sim", "--no-truth", "--car", f"red:arduino:pty:{path}"]
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", *sim]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        end = time.monotonic() + PATIENCE
        while not path.is_symlink():
            assert time.monotonic() < end
            time.sleep(0.01)
        with serial.Serial(str(path), timeout=PATIENCE) as port:
            port.write(opening(2))
            assert port.read_until(b"CSB0,PV8").endswith(b"CSB0,PV8"), "it tracks: it heard what was written"
        process.send_signal(signal.SIGTERM)
        stderr = process.stderr.read()
    assert not path.is_symlink()
    assert process.returncode == 0
    told = [b"gateway sim: stdout cannot be written"] if ">" in closed else []
    assert [line.partition(b" (")[0] for line in stderr.splitlines()] == told


def test_lamps_are_switched_and_things_moved_while_it_runs(started: list[SimProcess]) -> None:
    cars = [word for name in ("red", "green", "blue") for word in ("--car", f"{name}:arduino:pty")]
    sim = SimProcess(*cars, "--no-truth", "--world", str(EXAMPLES / "worlds" / "follow.yaml"))
    started.append(sim)
    red, _, _ = (sim.line() for _ in range(3))
    with serial.Serial(red["link"].removeprefix("serial://"), timeout=PATIENCE) as port:
        port.read_until(b"#")  # the rest of the first frame
        assert b",GM11#" in port.read_until(b"#")
        assert sim.ask(lamp="beacon", on=False) == {"ok": True, "lamp": "beacon"}
        port.reset_input_buffer()
        port.read_until(b"#")  # a frame that may have begun before
        assert b",GM00#" in port.read_until(b"#")
        port.write(RUN)
        assert sim.ask(thing="cart", x_m=0.9, y_m=1) == {"ok": True, "thing": "cart"}
        while sim.ask(car="red", ask="truth")["x_m"] < 1.0:  # past the place where the cart was
            time.sleep(0.01)
    world = sim.ask(ask="world")
    assert world["things"]["cart"] == {
        "x_m": 0.9,
        "y_m": 1.0,
        "heading_rad": 0.0,
        "radius_m": 0.06,
        "speed_m_s": 0.0,
        "carried_by": "",
    }
    lamp = world["lamps"]["beacon"]
    assert (lamp["x_m"], lamp["y_m"], lamp["on"], lamp["carried_by"]) == (0.9, 1.0, False, "cart")
    for fields, words in (
        ({"lamp": "sun"}, "lamp 'sun' is not in this world: use beacon"),
        ({"thing": ["cart"], "x_m": 1}, "is not in this world: use cart"),
        ({"lamp": "beacon"}, "nothing to change in lamp 'beacon': give on, x_m"),
        ({"lamp": "beacon", "on": 1}, "on 1 is not allowed: use true or false"),
        ({"lamp": "beacon", "color": 1}, "field 'color' is not allowed in lamp: use on, x_m"),
        ({"thing": "cart", "x_m": 1e9}, "a number from -100 to 100"),
        ({"thing": "cart", "speed_m_s": 0.1}, "speed_m_s 0.1 is not allowed: cart has no path"),
    ):
        answer = sim.ask(**fields)
        assert not answer["ok"]
        assert words in answer["error"]


def test_faults_of_the_command_line_come_at_their_time(started: list[SimProcess], tmp_path: Path) -> None:
    path = tmp_path / "red"
    sim = SimProcess("--car", f"red:arduino:pty:{path}", "--no-truth", "--fault", "red:link_drop@0.2+3")
    started.append(sim)
    sim.line()
    end = time.monotonic() + PATIENCE
    gone = False  # the drop of 3 s is long enough for a delayed poll
    while not (gone and path.exists()):
        gone = gone or not path.exists()
        assert time.monotonic() < end
        time.sleep(0.005)


def test_simulator_ends_with_parent(started: list[SimProcess], tmp_path: Path) -> None:
    path = tmp_path / "red"
    child = [sys.executable, "-m", "gateway.sim", "--car", f"red:arduino:pty:{path}", "--no-truth", "--parent"]
    script = f"import os, subprocess, sys; subprocess.Popen([*{child!r}, str(os.getpid())]); sys.stdin.read()"
    parent = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        assert parent.stdout.readline()
        assert path.exists()
    finally:
        parent.kill()
        parent.wait()
        assert parent.stdin is not None
        parent.stdin.close()
    end = time.monotonic() + PATIENCE
    while path.is_symlink():
        assert time.monotonic() < end
        time.sleep(0.01)
    parent.stdout.close()


def test_simulator_ends_if_parent_ended_earlier() -> None:
    """A supervisor that was killed while its processes started used to leave them behind."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    command = [sys.executable, "-m", "gateway.sim", "--car", "red:arduino:tcp", "--no-truth"]
    subprocess.run([*command, "--parent", str(ended.pid)], check=True, stdout=subprocess.DEVNULL, timeout=PATIENCE)


BAD = [
    ([], 2, "--car"),
    (["--car", "Red:arduino:pty"], 2, "a-z"),
    (["--car", "red:arduino:pty", "--car", "red:arduino:pty"], 2, "two cars have the name red"),
    (["--car", "red:arduino:pty", "--fault", "melt@1"], 2, "link_drop, rename, cut_write"),
    (["--car", "red:arduino:pty", "--fault", "blue:brownout@1"], 2, "'blue' is not simulated here"),
    (["--car", "red:arduino:pty", "--fleet", "No"], 2, "fleet name"),
    (["--car", "red:arduino:pty", "--connect", "nonsense"], 2, "endpoint 'nonsense'"),
    (["--car", "red:arduino:pty", "--world", "moon"], 2, "room"),
    (["--car", "red:arduino:pty", "--world", os.devnull], 2, "/dev/null:1:1: error: is a device, not a file"),
    (["--car", "red:arduino:pty:/nowhere/at/all", "--no-truth"], 1, "car red: no symlink can be made"),
    (["--car", "red:arduino:tcp://127.0.0.1:PORT", "--no-truth"], 1, "car red: cannot listen on 127.0.0.1:"),
]


@pytest.mark.parametrize(("arguments", "code", "words"), BAD)
def test_bad_arguments(arguments: list[str], code: int, words: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "gateway.sim", *(word.replace("PORT", port) for word in arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == code
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert (code == 2 and "usage" in done.stderr) or done.stderr.count("\n") == 1


def test_truth_is_on_bus_when_hub_comes_later(started: list[SimProcess]) -> None:
    endpoint = free_endpoint()
    sim = SimProcess("--car", "red:arduino:pty", "--connect", endpoint, "--fleet", "mine")
    started.append(sim)
    link = sim.line()["link"]
    hub = subprocess.Popen([sys.executable, "-m", "schemas.bus.hub", "--endpoint", endpoint])
    seen: list[Sample] = []
    worlds: list[Sample] = []
    try:
        end = time.monotonic() + PATIENCE
        with Bus.open(endpoint, start_hub=True, timeout_s=PATIENCE) as bus:
            bus.subscribe("mine/*/sim/truth", seen.append)
            bus.subscribe("mine/@sim/world", worlds.append)
            while not (seen and worlds):
                assert time.monotonic() < end
                time.sleep(0.01)
            with serial.Serial(link.removeprefix("serial://")) as port:
                port.write(RUN)
                while not any(sample.message().motor_left == 150 for sample in list(seen)):  # type: ignore[attr-defined]
                    assert time.monotonic() < end
                    time.sleep(0.01)
        assert seen[0].key == "mine/red/sim/truth"
        truth: Any = seen[0].message()
        assert (truth.car, truth.mode, truth.led) == ("red", "manual", "off")
        assert truth.y_m == pytest.approx(-1.05)
        sequences = [sample.sequence for sample in seen]
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
        world: Any = worlds[0].message()
        assert (len(world.walls), bool(world.line), len(world.lamps), len(world.things)) == (8, True, 0, 0)
    finally:
        sim.popen.terminate()
        assert sim.popen.wait(PATIENCE) == 0
        hub.terminate()
        hub.wait(PATIENCE)


def test_lamps_and_things_are_on_the_bus_too(started: list[SimProcess]) -> None:
    endpoint = free_endpoint()
    world = str(EXAMPLES / "worlds" / "follow.yaml")
    sim = SimProcess("--car", "red:arduino:pty", "--world", world, "--connect", endpoint)
    started.append(sim)
    sim.line()
    seen: list[Sample] = []
    end = time.monotonic() + PATIENCE
    try:
        with Bus.open(endpoint, start_hub=True, timeout_s=PATIENCE) as bus:
            bus.subscribe("fleet/@sim/world", seen.append)
            while not seen:
                assert time.monotonic() < end
                time.sleep(0.01)
            message: Any = seen[0].message()
            assert (message.car, len(message.walls), message.lamps[0].name, message.lamps[0].on) == (
                "@sim",
                4,
                "beacon",
                True,
            )
            assert (message.lamps[0].x_m, message.lamps[0].y_m) == (message.things[0].x_m, message.things[0].y_m)
            assert message.things[0].radius_m == pytest.approx(0.06)
            assert sim.ask(lamp="beacon", on=False)["ok"]
            while seen[-1].message().lamps[0].on:  # type: ignore[attr-defined]
                assert time.monotonic() < end
                time.sleep(0.01)
    finally:
        sim.popen.terminate()
        assert sim.popen.wait(PATIENCE) == 0


async def test_truth_that_nobody_can_see_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.sim.truth_publisher.HUB_WARNING_DELAY_S", 0.0)
    said: asyncio.Queue[str] = asyncio.Queue()
    simulation = Simulation(parse_cars(["red:arduino:tcp://127.0.0.1:0"]), seed=1)
    publishing = asyncio.create_task(TruthPublisher(simulation, free_endpoint(), "fleet", said.put_nowait).run())
    words = await asyncio.wait_for(said.get(), 20)
    assert "tcp/127.0.0.1:" in words
    await asyncio.sleep(3 * HUB_RETRY_DELAY_S)
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)
    assert said.empty()


async def test_car_options_reach_its_program() -> None:
    simulation = Simulation(parse_cars(["red:arduino+interval=0.2+head=BALA:pty", "blue:course:tcp"]))
    await simulation.start()
    data = bytearray()
    with serial.Serial(simulation.cars["red"].url.removeprefix("serial://"), timeout=0) as port:
        await until(lambda: data.extend(port.read(4096)) or data.count(b"$BALA,CSB") >= 5, "five reports in its rhythm")
    host, port_number = where(simulation, "blue")
    reader, writer = await asyncio.open_connection(host, port_number)
    writer.write(RUN)
    await until(lambda: simulation.cars["blue"].truth.driving, "drives")
    writer.write(MODE00)
    with pytest.raises(ConnectionResetError):  # its sockets end with it
        await reader.read()
    assert simulation.cars["blue"].truth.driving
    writer.close()
    await simulation.stop()


async def test_empty_battery_falls_then_car_and_link_are_off(pair: Simulation) -> None:
    host, port, writer = await driven(pair, "blue")
    await pair.inflict(Fault(FaultKind.EMPTY, "blue", for_s=0.3))
    await until(lambda: not pair.cars["blue"].truth.driving, "is off")
    firmware = pair.cars["blue"].firmware
    assert isinstance(firmware, Firmware)
    assert firmware._body.battery_v(asyncio.get_running_loop().time()) == CUT_OFF_V
    with pytest.raises(ConnectionError):
        await asyncio.open_connection(host, port)
    writer.close()


async def test_empty_battery_moves_nothing_until_the_link_is_back(tmp_path: Path) -> None:
    specs = parse_cars([f"w:wave_rover+mission:pty:{tmp_path / 'w'}"])
    simulation = Simulation(specs, seed=1)
    await simulation.start()
    car = simulation.cars["w"]
    try:
        await simulation.inflict(Fault(FaultKind.BROWNOUT, "w"))
        await until(lambda: car.truth is not None and car.truth.driving, "drives in its boot mission")
        await simulation.inflict(Fault(FaultKind.EMPTY, "w", for_s=0.0))
        await until(lambda: car._is_off, "is off")
        assert not car.press(Button.FORWARD)
        await simulation.inflict(Fault(FaultKind.BROWNOUT, "w"))
        assert isinstance(car.firmware, UgvCar)
        now = asyncio.get_running_loop().time()
        for second in range(1, 10):
            car.firmware.advance(now + second)
            assert not car.firmware.moving or second < 3, "it only rolls to a stop"
        assert car.firmware.truth.motor_left == 0
        await simulation.inflict(Fault(FaultKind.LINK_DROP, "w", for_s=0))
        assert car.press(Button.FORWARD)
    finally:
        await simulation.stop()


async def test_cut_that_waits_for_its_frame_is_called_off(pair: Simulation) -> None:
    await pair.inflict(Fault(FaultKind.CUT_WRITE, "green", bytes=3))
    await pair.inflict(Fault(FaultKind.LINK_DROP, "green", for_s=0))
    _, _, writer = await driven(pair, "green")
    writer.close()


async def test_brownout_restarts_course_program_with_its_port() -> None:
    simulation = Simulation(parse_cars(["c:course:tcp"]), seed=1)
    await simulation.start()
    try:
        host, port, writer = await driven(simulation, "c")
        writer.write(b"$4WD,MODE00#")
        await until(lambda: not simulation.cars["c"].truth.alive, "dies")
        await simulation.inflict(Fault(FaultKind.BROWNOUT, "c"))
        await until_open(host, port, PI_BOOT_S + 5.0)
        writer.close()
    finally:
        await simulation.stop()
