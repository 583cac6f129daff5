"""Tests the script that makes a computer that of a car, without installing. tests/soak/test_install_car.py installs."""

import re
import subprocess
import tomllib
from pathlib import Path
from typing import Final

import pytest
from packaging.requirements import Requirement

ROOT: Final = Path(__file__).parents[2]
SCRIPT: Final = ROOT / "deploy" / "install-car.sh"
CAR_IMPORTS: Final = {
    "click",
    "cryptography",
    "eclipse-zenoh",
    "foxglove-schemas-protobuf",
    "ifaddr",
    "protobuf",
    "pyserial",
    "segno",
    "zeroconf",
}


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["sh", str(SCRIPT), *words], capture_output=True, text=True, check=False)


@pytest.mark.soak  # needs shellcheck
def test_install_script_passes_shellcheck() -> None:
    done = subprocess.run(["shellcheck", "--shell=sh", str(SCRIPT)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.parametrize(
    "words",
    [
        ("--carr", "red"),
        ("--car",),
        ("--car", "red"),
        ("--link", "/dev/ttyUSB0"),
        ("--car", "Red", "--link", "/dev/ttyUSB0"),
        ("--car", "red/../x", "--link", "/dev/ttyUSB0"),
        ("--car", "red", "--link", "/dev/ttyUSB0", "--wheel", "/no/such.whl"),
        ("--wheel", __file__, "--clone"),
    ],
)
def test_wrong_use_makes_nothing(words: tuple[str, ...], tmp_path: Path) -> None:
    done = run("--prefix", str(tmp_path), *words)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)
    assert list(tmp_path.iterdir()) == []


def test_install_and_uninstall_keep_foreign_files(tmp_path: Path) -> None:
    own = tmp_path / "opt" / "car-fleet" / "own"
    own.parent.mkdir(parents=True)
    own.touch()
    for words in ((), ("--uninstall",)):
        assert run("--prefix", str(tmp_path), *words).returncode == 1
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [own]


def test_install_script_requirements_match_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    said = by_name([*project["dependencies"], *extras["secure"], *extras["ble"]])
    text = SCRIPT.read_text(encoding="ascii")
    wanted = by_name([each for words in re.findall(r"^needs='(.*)'$", text, re.MULTILINE) for each in words.split()])
    assert set(wanted) == CAR_IMPORTS
    assert by_name(extras["secure"]).keys() <= set(wanted), "`fleet join` imports them"
    wanted |= by_name(re.findall(r"^needs_ble='(.*)'$", text, re.MULTILINE))
    assert len(wanted) == len(CAR_IMPORTS) + 1
    assert wanted == {name: said[name] for name in wanted}


def by_name(requirements: list[str]) -> dict[str, Requirement]:
    return {found.name: found for found in map(Requirement, requirements)}
