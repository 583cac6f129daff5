"""Specs from a fleet file and a command line, and the differences between two specs."""

import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from fleet.commands import record
from fleet.fleetfile.fleet_file import parse_fleet, people_table
from fleet.quota import Quota
from fleet.supervisor.reload import compare
from fleet.supervisor.spec import (
    SIMULATED,
    CarProcessSpec,
    FleetSpec,
    UpOptions,
    build_spec,
    coordinator_command,
    coordinator_fleet_file,
    gateway_command,
    recorder_command,
    simulator_command,
)
from schemas.duration import parse_duration
from schemas.rights import NO_PEOPLE, People
from schemas.yaml_document.document import BadFile
from tests.support.driver_package import installed_driver
from tests.support.text_parts import has_parts

FILE = """
name: lab
endpoint: tcp/127.0.0.1:7999
record: {to: kept, quota: 20GB}
defaults: {limits: {longest_drive_s: 3}}
cars:
  ann: {link: /dev/ttyUSB0, platform: stm32+imu}
  bob: {link: "tcp://192.168.1.7:8888", limits: {on_battery_low: stop}}
"""


def test_file_says_it_all(tmp_path: Path) -> None:
    spec = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), UpOptions())
    assert (spec.fleet, spec.endpoint, spec.record) == ("lab", "tcp/127.0.0.1:7999", True)
    assert (spec.recordings, spec.quota) == (tmp_path / "kept", Quota(20 * 10**9))
    assert [(car.name, car.link, car.platform) for car in spec.cars.values()] == [
        ("ann", "/dev/ttyUSB0", "stm32+imu"),
        ("bob", "tcp://192.168.1.7:8888", "auto"),
    ]
    assert not spec.simulated


def test_cars_of_another_package_are_not_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "cars: {max: {link: LINK, platform: tank}, red: {link: sim, platform: stm32}}"
    with installed_driver(tmp_path, monkeypatch, "tests.support.tank"):
        with pytest.raises(BadFile) as bad:
            parse_fleet(text.replace("LINK", "sim"), tmp_path / "fleet.yaml")
        assert len(bad.value.problems) == 1
        assert "cars.max.link" in str(bad.value)
        file = parse_fleet(text.replace("LINK", "/dev/ttyUSB0"), tmp_path / "fleet.yaml")
        assert [each.platform for each in build_spec(file, UpOptions()).cars.values()] == ["tank", "stm32"]
        for count, others in ((2, ["red"]), (3, ["red", "green"])):
            spec = build_spec(file, UpOptions(simulated=count))
            assert [each.name for each in spec.cars.values()] == [each.name for each in spec.simulated] == others
            (warning,) = spec.warnings
            assert has_parts(warning, "max … cannot be simulated … tank")
        with pytest.raises(ValueError, match=r"max .* cannot be simulated"):
            build_spec(file, UpOptions(simulated=1))


@pytest.mark.parametrize("longest_drive_s", ["3", "3600", "0.25", "0.000001", "1234.5678"])
def test_gateway_takes_any_duration_of_a_file(longest_drive_s: str, tmp_path: Path) -> None:
    text = FILE.replace("longest_drive_s: 3}", f"longest_drive_s: {longest_drive_s}}}")
    words = build_spec(parse_fleet(text, tmp_path / "fleet.yaml"), UpOptions()).cars["ann"].arguments
    given = words[words.index("--longest-drive") + 1]
    assert parse_duration(given, max_s=3600) == float(longest_drive_s)


@pytest.mark.parametrize(("quota", "size"), [("20GB", 20e9), ("1 MB", 1e6), ("999999GB", 999_999e9), ("999TB", 999e12)])
def test_recorder_takes_any_quota_and_place_of_a_file(quota: str, size: float, tmp_path: Path) -> None:
    spec = build_spec(parse_fleet(FILE.replace("20GB", quota), tmp_path / "fleet.yaml"), UpOptions())
    interpreter, _, program, *words = recorder_command(spec, "tcp/127.0.0.1:7999")
    assert (interpreter, program, words[:2]) == (sys.executable, "fleet.cli", ["record", "run"])
    given = record.run.make_context("run", words[2:]).params
    assert (given["place"], given["quota"]) == (tmp_path / "kept", size)
    assert given["fleet_file"] == tmp_path / "fleet.yaml"


PEOPLE = """
people: {lee: {drives: ["@a"]}, ana: {drives: [bob]}, kim: {}, teacher: {rank: lead}}
groups: {a: [ann]}
"""


def test_each_gateway_gets_the_people_who_may_drive_its_car(tmp_path: Path) -> None:
    spec = build_spec(parse_fleet(FILE + PEOPLE, tmp_path / "fleet.yaml"), UpOptions(simulated=3))
    assert {name: _people(car.arguments) for name, car in spec.cars.items()} == {
        "ann": listed("lee", "ana:other", "kim", "teacher:lead"),
        "bob": listed("lee:other", "ana", "kim", "teacher:lead"),
        "red": listed("lee:other", "ana:other", "kim", "teacher:lead"),  # a simulated car beside those of the file
    }
    nobody = build_spec(parse_fleet(FILE + "people: {}\n", tmp_path / "fleet.yaml"), UpOptions())
    assert _people(nobody.cars["ann"].arguments) == ["--people-only"]
    everyone = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), UpOptions())
    assert _people(everyone.cars["ann"].arguments) == []
    # The coordinator knows the same people from its copy of the file.
    known = [
        people_table(parse_fleet(coordinator_fleet_file(each), tmp_path / "copy.yaml", unbound=True).people)
        for each in (spec, nobody, everyone)
    ]
    assert known == [People.parse(["lee", "ana", "kim", "teacher:lead"]), People({}), NO_PEOPLE]
    assert compare(everyone, spec).spec.people == spec.people


def listed(*people: str) -> list[str]:
    return ["--people-only", *(word for name in people for word in ("--person", name))]


def _people(arguments: tuple[str, ...]) -> list[str]:
    return list(arguments[arguments.index("--people-only") :]) if "--people-only" in arguments else []


def test_command_line_wins(tmp_path: Path) -> None:
    asked = UpOptions(plan=Path("p.yaml"), record=True, out=Path("o"), connect="tcp/127.0.0.1:7000", fleet="x")
    spec = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), asked)
    assert (spec.fleet, spec.endpoint, spec.record, spec.recordings, spec.plan) == (
        "x",
        "tcp/127.0.0.1:7000",
        True,
        Path("o"),
        Path("p.yaml"),
    )


def test_simulated_are_first_the_files_cars_then_ours(tmp_path: Path) -> None:
    spec = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), UpOptions(simulated=3))
    assert [(car.name, car.platform) for car in spec.simulated] == [
        ("ann", "stm32+imu"),
        ("bob", "arduino"),
        ("red", "arduino"),
    ]
    one = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), UpOptions(simulated=1))
    assert [car.name for car in one.simulated] == ["ann"]
    assert one.cars["bob"].link == "tcp://192.168.1.7:8888"


def test_simulated_car_keeps_the_options_of_its_platform(tmp_path: Path) -> None:
    text = "cars: {ann: {link: COM3, platform: auto+text+head=BaLa}, bob: {link: COM4, platform: stm32+3s}}"
    spec = build_spec(parse_fleet(text, tmp_path / "fleet.yaml"), UpOptions(simulated=2))
    assert [car.platform for car in spec.simulated] == ["arduino+text+head=BaLa", "stm32+3s"]


@pytest.mark.parametrize("count", [1, 8, 9, 50, 200])
def test_any_number_of_cars_without_a_file(count: int) -> None:
    spec = build_spec(None, UpOptions(simulated=count))
    assert len(spec.cars) == len(spec.simulated) == count
    assert next(iter(spec.cars)) == "red"


def test_every_command_is_one_that_its_program_takes(tmp_path: Path) -> None:
    """With an invalid last argument, each parser accepts all others."""
    spec = build_spec(parse_fleet(FILE, tmp_path / "fleet.yaml"), UpOptions(simulated=1))
    endpoint = "tcp/127.0.0.1:1"
    commands = [
        gateway_command(spec, spec.cars["bob"], "tcp://127.0.0.1:1", endpoint),
        simulator_command(spec, tmp_path, endpoint),
        recorder_command(spec, endpoint),
        coordinator_command(spec, tmp_path / "plan.yaml", tmp_path / "fleet.yaml", endpoint),
    ]
    for command in commands:
        assert command[0] == sys.executable
        done = subprocess.run([*command, "--nonsense"], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert "--nonsense" in done.stderr, done.stderr


def test_simulated_holds_belong_to_folder_and_real_ones_to_link(tmp_path: Path) -> None:
    def holds_of(folder: str, car: str) -> str | None:
        (tmp_path / folder).mkdir(exist_ok=True)
        spec = build_spec(parse_fleet(FILE, tmp_path / folder / "fleet.yaml"), UpOptions(simulated=1))
        command = gateway_command(spec, spec.cars[car], "serial:///run/of/today.tty", "tcp/127.0.0.1:1")
        return command[command.index("--holds-of") + 1] if "--holds-of" in command else None

    assert holds_of("a", "bob") is None
    assert holds_of("a", "ann") == f"sim in {tmp_path / 'a'}"
    assert holds_of("b", "ann") == f"sim in {tmp_path / 'b'}"


CARS = {name: CarProcessSpec(name, f"/dev/{name}") for name in ("ann", "bob")}
OLD = FleetSpec(cars=CARS | {"sim": CarProcessSpec("sim", SIMULATED, "arduino")})


def test_nothing_new_is_no_change() -> None:
    found = compare(OLD, OLD)
    assert (found.spec, found.removed, found.restarted, found.words) == (OLD, (), (), ())


def test_cars_come_go_and_change() -> None:
    cars = {name: car for name, car in OLD.cars.items() if name != "ann"}
    cars |= {"bob": CarProcessSpec("bob", "/dev/other"), "eve": CarProcessSpec("eve", "/dev/eve")}
    found = compare(OLD, replace(OLD, cars=cars))
    assert found.removed == ("ann",)
    assert found.restarted == ("bob", "eve")
    assert found.spec.cars == cars
    assert found.words == ("bob is restarted", "eve is added", "ann is removed")


def test_other_groups_and_colors_are_told() -> None:
    """They were in force, but `fleet reload` said that nothing had changed."""
    old = replace(OLD, colors={"ann": "#010203", "bob": "#030201", "sim": "#000001"}, groups={"a": ("ann",)})
    new = replace(old, colors={**old.colors, "bob": "#ff0000", "eve": "#00ff00"}, groups={"a": ("ann", "bob")})
    found = compare(old, new)
    assert found.words == ("the groups have changed", "in another color now: bob")
    assert (found.spec.groups, found.spec.colors) == (new.groups, new.colors)
    assert compare(new, new).words == ()


def test_gateway_of_a_simulated_car_restarts_with_other_people() -> None:
    car = replace(OLD.cars["sim"], arguments=("--people-only", "--person", "lee"))
    found = compare(OLD, replace(OLD, cars={**OLD.cars, "sim": car}))
    assert (found.restarted, found.words, found.spec.cars["sim"]) == (("sim",), ("sim is restarted",), car)


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (replace(OLD, fleet="lab"), "the fleet's name"),
        (replace(OLD, endpoint="tcp/127.0.0.1:7"), "the endpoint"),
        (replace(OLD, world=Path("w")), "the world"),
        (replace(OLD, recordings=Path("r")), "where recordings go"),
        (replace(OLD, record=False), "whether the fleet is recorded"),
        (replace(OLD, cars={**OLD.cars, "two": CarProcessSpec("two", SIMULATED)}), "two (a simulated car)"),
        (replace(OLD, cars={**OLD.cars, "sim": CarProcessSpec("sim", SIMULATED, "stm32")}), "sim (a simulated car)"),
        (replace(OLD, cars={**OLD.cars, "sim": CarProcessSpec("sim", "/dev/sim")}), "sim (a simulated car)"),
    ],
)
def test_reload_keeps_fields_that_need_restart(new: FleetSpec, words: str) -> None:
    found = compare(OLD, new)
    assert found.spec == OLD
    assert (found.words, found.needs_restart) == ((), (words,))
