"""`fleet check` recognizes fleet files, plans and worlds. It checks plan and world together with their fleet file."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fleet.commands.check import FileKind, check, recognize
from tests.support.ports import free_endpoint

PLAN = "roles:\n  line: {mode: tracking}\n"
NEVER = f"{PLAN}rules:\n  - {{when: {{any_car: battery.voltage_v < 0}}, then: {{who: all_cars, mode: manual}}}}\n"
WORLD = "room: {width_m: 4.0, depth_m: 3.0}\n"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEET_ENDPOINT", free_endpoint())
    (tmp_path / "plan.yaml").write_text(PLAN)
    (tmp_path / "never.yaml").write_text(NEVER)
    (tmp_path / "world.yaml").write_text(WORLD)
    (tmp_path / "fleet.yaml").write_text(
        "plan: never.yaml\nworld: world.yaml\ncars:\n  red: {link: ble://AA:BB:CC:DD:EE:FF}\n"
    )

    def command(*arguments: str) -> Result:
        return CliRunner().invoke(check, arguments)

    return command


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("cars: {red: {link: sim}}", FileKind.FLEET),
        ("fixed: {red: {mode: tracking}}", FileKind.PLAN),
        ("cars: {red: {x_m: 1, y_m: 2}}", FileKind.WORLD),
        ("name: lab\nplan: p.yaml\ncars: {}", FileKind.FLEET),
        ("roles: {a: {mode: tracking}}\nfixed: {}", FileKind.PLAN),
        ("rules: []", FileKind.PLAN),
        ("walls: []\ncars: {}", FileKind.WORLD),
        ("roles: {a: [", FileKind.PLAN),
        ("[1, 2]", FileKind.FLEET),
        ("roles: " + 20_000 * "[", FileKind.PLAN),
        ("name: 2020-99-99", FileKind.FLEET),
        ("", FileKind.FLEET),
    ],
    ids=lambda value: str(value)[:40],
)
def test_file_is_recognized_by_its_content(text: str, kind: FileKind) -> None:
    assert recognize(text) is kind


def test_check_of_fleet_file_includes_plan_and_world(run: object) -> None:
    done = run()  # type: ignore[operator]
    assert done.exit_code == 1, done.output
    assert "never.yaml" in done.stdout
    assert ": error: " in done.stdout
    assert "world.yaml: world, can be simulated: no mistakes found" in done.stdout


def test_plans_and_worlds_are_checked_by_themselves(run: object) -> None:
    done = run("plan.yaml", "world.yaml")  # type: ignore[operator]
    assert done.exit_code == 0, done.output
    assert done.stdout == (
        "plan.yaml: plan, 1 role, 0 rules, 0 phases: no mistakes found\n"
        "world.yaml: world, can be simulated: no mistakes found\n"
    )


def test_check_of_world_uses_simulated_cars_of_fleet_file(run: object) -> None:
    Path("world.yaml").write_text("room: {width_m: 4.0, depth_m: 3.0}\nlamps: {sun: {carried_by: rad}}\n")
    assert run("world.yaml").exit_code == 0, "any car may exist"  # type: ignore[operator]
    done = run("fleet.yaml", "--json")  # type: ignore[operator]
    assert done.exit_code == 2
    (found,) = [
        each for each in map(json.loads, done.stdout.splitlines()) if each.get("file", "").endswith("/world.yaml")
    ]
    assert (found["severity"], found["line"], found["column"]) == ("error", 2, 27)
    assert found["words"] == "lamps.sun.carried_by: no car or thing 'rad' is simulated here: use red"


def test_every_wrong_file_is_named_and_the_worst_counts(run: object) -> None:
    Path("bad.yaml").write_text("roles: {a: {mde: tracking}}\n")
    Path("bad_world.yaml").write_text("room: 5\nwalls: 7\n")
    done = run("never.yaml", "bad.yaml", "bad_world.yaml", "nowhere.yaml", "--json")  # type: ignore[operator]
    assert done.exit_code == 2
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert {Path(each["file"]).name for each in found} == {"never.yaml", "bad.yaml", "bad_world.yaml", "nowhere.yaml"}
    assert all({"file", "severity", "line", "column", "words"} <= set(each) for each in found)
