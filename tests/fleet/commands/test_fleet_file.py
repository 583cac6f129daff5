"""`fleet init, check, bind, schema` with simulated cars on real PTYs. Commands that ask run at a terminal."""

import fcntl
import io
import json
import os
import pty
import re
import subprocess
import sys
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fleet.coordinator.observer import listed_cars
from fleet.fleetfile.editor import CannotEdit, set_link
from fleet.fleetfile.fleet_file import parse_fleet, read_fleet
from fleet.fleetfile.template import NewCar, format_new_file
from fleet.policy.lint.lint import find_faults
from fleet.policy.plan.plan_parser import parse as parse_plan
from schemas.yaml_document.document import BadFile
from tests.support import in_process
from tests.support.message_length import LINE
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, GatewayProcess, TcpCar, wait_for
from tests.support.terminal import Terminal

Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def command(tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Return a function that runs `fleet ...` to its end, in a directory of its own, without a terminal."""

    def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
        with monkeypatch.context() as here:
            here.setenv("FLEET_ENDPOINT", endpoint)
            here.setenv("COLUMNS", "200")
            here.setattr(sys, "stdin", io.StringIO())
            done = in_process.fleet(*arguments, cwd=tmp_path)
        assert "Traceback" not in done.stderr, done.stderr
        return done

    return run


@pytest.fixture
def terminal(tmp_path: Path, endpoint: str) -> Iterator[Callable[..., Terminal]]:
    """Yield a function that starts `fleet ...` at a terminal."""
    started: list[Terminal] = []

    def start(*arguments: str) -> Terminal:
        environment = {"FLEET_ENDPOINT": endpoint, "PYTHONPATH": str(Path.cwd())}
        started.append(Terminal("fleet.cli", *arguments, environment=environment, directory=tmp_path))
        return started[-1]

    yield start
    for each in started:
        each.close()


class Port:
    """A silent serial port, and the bytes written to it."""

    def __init__(self) -> None:
        self._controller, self.device = pty.openpty()
        tty.setraw(self._controller)
        os.set_blocking(self._controller, False)
        self.path = os.ttyname(self.device)

    def received(self) -> bytes:
        try:
            return os.read(self._controller, 4096)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        os.close(self.device)
        os.close(self._controller)


@pytest.fixture
def port() -> Iterator[Port]:
    made = Port()
    yield made
    made.close()


@pytest.fixture
def tcp() -> Iterator[TcpCar]:
    made = TcpCar()
    yield made
    made.close()


@pytest.fixture
def simulate(tmp_path: Path, endpoint: str) -> Iterator[Callable[..., GatewayProcess]]:
    """Yield a function that starts simulated cars on PTYs of their names in the directory."""
    started: list[GatewayProcess] = []

    def begin(*cars: str) -> GatewayProcess:
        described = [word for car in cars for word in ("--car", f"{car}:arduino:pty:{tmp_path / car}.tty")]
        arguments = ["-m", "gateway.cli", "sim", "--no-truth", "--seed", "3", *described]
        started.append(GatewayProcess(arguments, tmp_path / "sim.log", {"FLEET_ENDPOINT": endpoint}))
        for _ in cars:
            started[-1].line()
        return started[-1]

    yield begin
    for each in started:
        each.end()


# ------------------------------------------------------------------ check


def test_check_reports_all_faults_of_file(command: Command, tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("cars:\n  red: {lnk: COM1}\n  Red: {link: x}\n")
    done = command("check")
    assert (done.returncode, done.stdout) == (2, "")
    places = [line.split(": ")[0] for line in done.stderr.splitlines()]
    assert places == ["fleet.yaml:2:3", "fleet.yaml:2:9", "fleet.yaml:3:3", "fleet.yaml:3:15"]
    done = command("check", "--json")
    assert (done.returncode, done.stderr) == (2, "")
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(each["line"], each["column"], each["field"]) for each in told][1] == (2, 9, "cars.red.lnk")


def test_check_without_file_is_wrong_use(command: Command) -> None:
    done = command("check", "other.yaml")
    assert done.returncode == 2
    assert "other.yaml: error: " in done.stderr
    assert "fleet init" in command("check").stderr


def test_ports_are_looked_at_and_left_alone(command: Command, port: Port, tcp: TcpCar, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    gone = TcpCar()
    gone.close()
    cars = {
        "there": {"link": port.path},
        "missing": {"link": "/dev/nothing-of-this-name"},
        "no_port": {"link": str(tmp_path / "file")},
        "usb": {"link": "serial://?vid=ffff&serial=of-nobody"},
        "pi": {"link": tcp.link, "platform": "raspberry_pi"},
        "found_out": {"link": "tcp://127.0.0.1:8888"},
        "closed_bridge": {"link": gone.link, "platform": "arduino"},
        "no_host": {"link": "tcp://nobody.invalid:8888"},
        "ble": {"link": "ble://aa:bb:cc:dd:ee:ff"},
        "sim": {"link": "sim", "platform": "stm32"},
    }
    (tmp_path / "fleet.yaml").write_text(json.dumps({"cars": cars}))
    done = command("check", "--json")
    assert done.returncode == 1, done.stderr
    found = {each["car"]: each for each in map(json.loads, done.stdout.splitlines())}
    assert list(found) == list(cars)
    assert {car for car, each in found.items() if each["ok"]} == {"there", "pi", "found_out", "ble", "sim"}
    for car, words in {
        "there": "not opened",
        "missing": "no such device",
        "no_port": "serial port",
        "usb": "no such USB device",
        "pi": "was not tried",
        "closed_bridge": "nothing listens on port",
        "no_host": "nobody.invalid",
    }.items():
        assert words in found[car]["words"]
    assert port.received() == b""
    assert tcp.connections == 0


@pytest.mark.parametrize("platform", ["arduino", "ugv_rover"])
def test_check_connects_to_bridge_and_sends_nothing(
    command: Command, tcp: TcpCar, tmp_path: Path, platform: str
) -> None:
    (tmp_path / "fleet.yaml").write_text(f"cars: {{red: {{platform: {platform}, link: '{tcp.link}'}}}}")
    done = command("check")
    assert done.returncode == 0
    assert done.stdout.startswith(f"red  ok     {tcp.link}: ")
    wait_for(lambda: tcp.hung_up, "it is known what was sent")
    assert (tcp.connections, tcp.received) == (1, [])


def test_check_names_process_that_locks_port(command: Command, port: Port, tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(f"cars: {{red: {{link: {port.path}}}}}")
    fcntl.flock(port.device, fcntl.LOCK_EX)  # as gateways do
    done = command("check")
    if Path("/proc/locks").exists():
        assert done.returncode == 1
        assert f"by process {os.getpid()} (" in done.stdout
        fcntl.flock(port.device, fcntl.LOCK_UN)
        assert "there, permitted, free" in command("check").stdout
    else:
        assert "not known here" in done.stdout


def test_check_leaves_car_with_gateway_alone(command: Command, endpoint: str, tmp_path: Path) -> None:
    fleet = FleetProcesses(endpoint, tmp_path)
    try:
        _, [link] = fleet.simulate("red:arduino:pty")
        fleet.gateway(link)
        fleet.ready()
        (tmp_path / "fleet.yaml").write_text(f"cars: {{red: {{link: {link}}}}}")
        done = command("check")
        assert done.returncode == 0
        assert done.stdout.startswith(f"red  ok     {link}: ")
        assert done.stdout.endswith(" online\n")
    finally:
        fleet.close()


# ------------------------------------------------------------------ schema, init


def test_schema_is_printed(command: Command) -> None:
    assert json.loads(command("schema").stdout)["title"] == "fleet file"


def test_init_writes_valid_file_of_found_links(command: Command, simulate: Any, tmp_path: Path, port: Port) -> None:
    simulate("a", "b")
    links = [f"{tmp_path}/{name}.tty" for name in "ab"]
    told = [word for link in [*links, port.path, "tcp://pi:8888"] for word in ("--link", link)]
    done = command("init", "--yes", "--for", "5", *told)
    assert done.returncode == 0, done.stderr
    assert "fleet.yaml with red, green, blue" in done.stdout
    written = (tmp_path / "fleet.yaml").read_text()
    assert written.startswith("# yaml-language-server: $schema=")
    fleet = read_fleet(tmp_path / "fleet.yaml")
    found = [(car.link, car.platform) for car in fleet.cars.values()]
    assert found == [*((f"serial://{link}", "arduino") for link in links), ("tcp://pi:8888", "auto")]

    done = command("init", "--yes", "--link", links[0])
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert (tmp_path / "fleet.yaml").read_text() == written
    done = command("init", "--yes", "--force", "--for", "5", "--link", links[1])
    assert done.returncode == 0, done.stderr
    assert list(read_fleet(tmp_path / "fleet.yaml").cars) == ["red"]


def test_any_name_and_device_make_valid_fleet_file() -> None:
    cars = [NewCar(name, "COM1" if name == "red" else f"tcp://pi:{number}", "auto", "#000000", "a # 'car': \"x\"")
            for number, name in enumerate(("red", "10", "null", "true", "0x1", "on", "a-b"), 1)]  # fmt: skip
    fleet = parse_fleet(format_new_file(cars), Path("f.yaml"))
    assert [(car.name, car.link) for car in fleet.cars.values()] == [(car.name, car.link) for car in cars]


@pytest.mark.parametrize("link", [
    "/dev/ttyUSB0", "COM3", "ble://A4:C1:38:00:00:01", "ble://name=BT04-blue", "ble://name=my car #1",
    "serial://?vid=1a86&serial=A50285BI", "tcp://192.168.1.7:8888",
])  # fmt: skip
def test_each_link_is_written_as_it_is(link: str) -> None:
    written = parse_fleet(format_new_file([NewCar("red", link, "auto", "#e01b24")]), Path("f.yaml"))
    direct = parse_fleet(json.dumps({"cars": {"red": {"link": link}}}), Path("f.yaml"))
    assert written.cars["red"].link == direct.cars["red"].link


@pytest.mark.parametrize("count", [1, 2, 3, 9, 40])
def test_simulated_cars_are_written_with_a_plan_that_uses_all(command: Command, tmp_path: Path, count: int) -> None:
    done = command("init", "--sim", str(count))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Wrote fleet.yaml and plan.yaml with red")
    assert max(map(len, done.stdout.splitlines())) <= LINE
    assert [line.strip() for line in done.stdout.splitlines() if line.startswith("  ")] == [
        "fleet check",
        "fleet up",
        "fleet up --plan plan.yaml",
    ]
    fleet = read_fleet(tmp_path / "fleet.yaml")
    assert {car.link for car in fleet.cars.values()} == {"sim"}
    assert (len(fleet.cars), fleet.plan) == (count, None)
    plan = parse_plan((tmp_path / "plan.yaml").read_text())
    found = find_faults(plan, listed_cars(fleet))
    assert (found.errors, found.warnings) == ((), ())
    assert sum(role.count or 1 for role in plan.roles.values()) == count


@pytest.mark.parametrize("exists", [True, False])
def test_without_a_terminal_it_says_why_nothing_was_written(command: Command, tmp_path: Path, exists: bool) -> None:
    """No question may end in silence where nobody can answer it."""
    if exists:
        (tmp_path / "fleet.yaml").write_text("mine\n")
    port = Port()
    try:
        done = command("init", "--for", "0.5", "--link", port.path)
    finally:
        port.close()
    assert done.returncode == 1
    assert "terminal" in done.stderr
    assert ("--force" if exists else "--yes") in done.stderr
    assert [path.read_text() for path in tmp_path.glob("*.yaml")] == (["mine\n"] if exists else [])


@pytest.mark.parametrize("name", ["fleet.yaml", "plan.yaml"])
def test_simulated_cars_overwrite_nothing(command: Command, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine\n")
    done = command("init", "--sim", "3")
    assert done.returncode == 2
    assert done.stderr.startswith(f"fleet: {name} exists")
    assert "--force" in done.stderr
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine\n")]
    other = command("init", "--sim", "3", "--out", "other.yaml")
    assert other.returncode == (2 if name == "plan.yaml" else 0)
    assert other.stderr.count("--out ") == (name == "plan.yaml")
    assert command("init", "--sim", "3", "--force").returncode == 0
    assert len(read_fleet(tmp_path / "fleet.yaml").cars) == 3
    assert parse_plan((tmp_path / "plan.yaml").read_text()).roles


def test_nothing_found_says_what_to_do(command: Command, port: Port, tmp_path: Path) -> None:
    done = command("init", "--yes", "--for", "0.5", "--link", port.path)
    assert done.returncode == 1
    for words in ("No car found", "fleet scan", "--link tcp://", "fleet init --sim 3"):
        assert words in done.stderr
    assert not (tmp_path / "fleet.yaml").exists()


def test_link_that_is_none_is_wrong_use(command: Command) -> None:
    done = command("init", "--yes", "--link", "11:22:33:44:55:66")
    assert done.returncode == 2
    assert "not a link" in done.stderr


def test_person_names_the_cars(terminal: Callable[..., Terminal], simulate: Any, port: Port, tmp_path: Path) -> None:
    simulate("a")
    (tmp_path / "fleet.yaml").write_text("mine\n")
    init = terminal("init", "--for", "5", "--link", f"{tmp_path}/a.tty", "--link", port.path)
    init.until("Overwrite it? [y/N]: ")
    init.type("y")
    init.until("its name (- to leave it out) [red]: ")
    init.type("Rosa")
    init.until('"Rosa" is not a car name: use 1 to 32 of a-z')
    init.until("[red]: ")
    init.type("rosa")
    init.until("its platform [arduino]: ")
    init.type("arduno")
    init.until('Unknown platform "arduno". Did you mean arduino?')
    init.type("stm32+arm")
    init.until("its color [#50c8c8]: ")
    init.type("#FF00aa")
    init.until("silent")
    init.until("its name (- to leave it out) [-]: ")
    init.type("")
    init.until("Wrote fleet.yaml with rosa")
    assert init.wait() == 0
    (rosa,) = read_fleet(tmp_path / "fleet.yaml").cars.values()
    assert (rosa.name, rosa.platform, rosa.color) == ("rosa", "stm32+arm", "#ff00aa")


def test_init_keeps_existing_file_without_consent(terminal: Callable[..., Terminal], tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("mine\n")
    init = terminal("init")
    init.until("Overwrite it? [y/N]: ")
    init.type("")
    assert init.wait() == 130
    assert (tmp_path / "fleet.yaml").read_text() == "mine\n"


# ------------------------------------------------------------------ bind

UNBOUND = """\
# the lab's cars
cars:
  red:   # the old one
    platform: arduino
  green: {platform: arduino, color: "#00ff00"}   # the fast one
  blue:
    link: /dev/nothing-of-this-name   # was unplugged
"""


def test_unknown_links_blink_and_person_names_them(
    terminal: Callable[..., Terminal], simulate: Any, tmp_path: Path
) -> None:
    sim = simulate("a", "b", "c")
    (tmp_path / "fleet.yaml").write_text(UNBOUND)
    told = [word for name in "abc" for word in ("--link", f"{tmp_path}/{name}.tty")]
    bind = terminal("bind", "--for", "2", *told)
    for number, answers in enumerate((("green",), ("again", "blue"), ("rover",)), 1):
        bind.until(f"{number} of 3: serial://{tmp_path}/{'abc'[number - 1]}.tty")
        for answer in answers:
            bind.until("Which car blinked?")
            bind.until("for none)")
            for car in "abc":
                truth = sim.say({"car": car, "ask": "truth"})
                assert not truth["motor_left"]
                assert not truth["motor_right"]
            bind.type(answer)
        if "blue" in answers:
            bind.until("blue has the link /dev/nothing-of-this-name. Replace it with this one?")
            bind.type("y")
    bind.until("still without a link: red")
    assert bind.wait() == 1
    assert (tmp_path / "fleet.yaml").read_text() == UNBOUND.replace(
        "green: {", f'green: {{link: "serial://{tmp_path}/a.tty", '
    ).replace(
        "/dev/nothing-of-this-name   # was unplugged",
        f'"serial://{tmp_path}/b.tty"   # was unplugged\n  rover: {{link: "serial://{tmp_path}/c.tty"}}',
    )


def test_bind_without_new_car_fails(command: Command, port: Port, tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(f"cars: {{red: {{link: {port.path}}}}}")
    done = command("bind", "--for", "0.5", "--link", port.path)
    assert done.returncode == 1
    assert "No new car" in done.stderr
    assert port.received() == b""


@pytest.mark.parametrize(
    ("text", "car", "after"),
    [
        ("cars:\n  red: {link: COM1} # x\n", "red", 'cars:\n  red: {link: "COM9"} # x\n'),
        ("cars:\n  red:\n    link: >-\n      COM1\n  b: {link: COM2}\n", "red", None),
        ("cars: {red: {}}", "red", 'cars: {red: {link: "COM9"}}'),
        ("cars: {red: {link: COM1}}", "blue", 'cars: {red: {link: COM1}, blue: {link: "COM9"}}'),
        ("cars:\r\n  red: {link: COM1}\r\n", "b", 'cars:\r\n  red: {link: COM1}\r\n  b: {link: "COM9"}\r\n'),
        (
            "cars:\n  red: {link: COM1}\n\n# end\nname: x",
            "1",
            'cars:\n  red: {link: COM1}\n  "1": {link: "COM9"}\n\n# end\nname: x',
        ),
        ("cars:\n  red: {link: COM1}", "null", 'cars:\n  red: {link: COM1}\n  "null": {link: "COM9"}'),
        ("cars: {red: &r {platform: stm32}, b: *r}", "red", None),
        ("cars:\n  red: &r {link: COM1}\n", "red", 'cars:\n  red: &r {link: "COM9"}\n'),
    ],
)
def test_set_link_edits_text_in_place(text: str, car: str, after: str | None) -> None:
    if after is None:
        with pytest.raises((CannotEdit, BadFile), match=re.escape(car)):
            set_link(text, Path("f.yaml"), car, "COM9")
    else:
        assert set_link(text, Path("f.yaml"), car, "COM9") == after


def test_set_link_refuses_link_of_other_car() -> None:
    with pytest.raises(BadFile, match="same port"):
        set_link("cars: {red: {link: COM9}, blue: {link: COM2}}", Path("f.yaml"), "blue", "com9")


def test_ambiguous_yaml_text_is_quoted() -> None:
    text = "cars:\n  red: &both\n    platform: stm32\n  blue: *both\n"
    with pytest.raises(CannotEdit, match=r'cars\.red\.link to "sim"'):
        set_link(text, Path("f.yaml"), "red", "sim")
