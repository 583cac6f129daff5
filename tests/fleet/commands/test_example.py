"""`fleet example` lists, prints and copies the examples of the package."""

import json
from pathlib import Path

import pytest

from fleet.commands.example import examples
from fleet.examples import EXAMPLES
from fleet.fleetfile.fleet_file import read_fleet
from tests.support.in_process import fleet


def test_each_file_is_listed_with_a_short_description() -> None:
    listed = [json.loads(line) for line in fleet("example", "list", "--json").stdout.splitlines()]
    files = {path for path in EXAMPLES.glob("*/*.*") if path.suffix in (".py", ".ipynb", ".yaml")}
    assert {Path(each["file"]) for each in listed} == {path for path in files if path.stem != "__init__"}
    assert {each["kind"] for each in listed} == {"program", "fleet", "plan", "world"}
    assert len({each["name"] for each in listed}) == len(listed)
    assert all(len(each["about"].split()) > 3 for each in listed)
    assert max(map(len, fleet("example", "list").stdout.splitlines())) <= 110


@pytest.mark.parametrize("name", ["1-patrol", "1-patrol.yaml", "plans/1-patrol", "plans/1-patrol.yaml"])
def test_one_is_shown_by_each_of_its_names(name: str) -> None:
    assert fleet("example", "show", name).stdout == (EXAMPLES / "plans" / "1-patrol.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(path.name for path in (EXAMPLES / "fleets").iterdir()))
def test_copied_fleet_file_has_its_plan_beside_it(name: str, tmp_path: Path) -> None:
    done = fleet("example", "copy", name, "lab", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    copied = read_fleet(tmp_path / "lab" / name)
    there = read_fleet(EXAMPLES / "fleets" / name)
    assert list(copied.cars) == list(there.cars)
    assert (there.plan is None) == (name != "sim.yaml")
    if there.plan is not None:
        assert copied.plan == tmp_path / "lab" / there.plan.name
        assert copied.plan.read_bytes() == there.plan.read_bytes()
    assert done.stdout.splitlines() == [
        f"wrote lab/{path}" for path in (name, *([there.plan.name] if there.plan else []))
    ]


def test_nothing_is_overwritten_without_force(tmp_path: Path) -> None:
    (tmp_path / "2-line-guide.yaml").write_text("mine\n")
    done = fleet("example", "copy", "sim", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("fleet: 2-line-guide.yaml exists already")
    assert [path.name for path in tmp_path.iterdir()] == ["2-line-guide.yaml"]
    assert fleet("example", "copy", "sim", "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "2-line-guide.yaml").read_text() != "mine\n"


def test_wrong_names_and_places(tmp_path: Path) -> None:
    done = fleet("example", "show", "patrol")
    assert done.returncode == 2
    assert done.stderr.startswith("fleet: ")
    assert '"patrol"' in done.stderr
    assert " mean 1-patrol?" in done.stderr
    assert "`fleet example list`" in fleet("example", "copy", "xyz").stderr
    done = fleet("example", "copy", "1-patrol", "plan.yaml", cwd=tmp_path)
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert done.stderr.startswith("fleet: plan.yaml ")
    (tmp_path / "file").touch()
    done = fleet("example", "copy", "room", "file/lab", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "file/lab " in done.stderr
    assert ": Not a directory" in done.stderr


def test_names_are_completed() -> None:
    from click.shell_completion import ShellComplete

    from fleet.commands.example import example

    found = ShellComplete(example, {}, "fleet example", "_X").get_completions(["show"], "drive")
    assert [each.value for each in found] == ["drive_one"]
    assert "drive_one" in examples()
