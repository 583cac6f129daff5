"""Tests the script that makes a computer that of a car, without installing. tests/soak/test_install_car.py installs."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
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
    "msgspec",
    "protobuf",
    "pyserial",
    "segno",
    "zeroconf",
}


IMPORTED: Final = """
import sys
from importlib import import_module, metadata
for name in (
    "gateway.car_gateway", "gateway.cli", "gateway.stop_without_hub", "gateway.tools.scan",
    "gateway.drivers.yahboom.driver", "gateway.drivers.waveshare.driver",
    "fleet.cli", "fleet.commands.drive", "fleet.commands.hub", "fleet.commands.observe",
):
    import_module(name)
known, names = metadata.packages_distributions(), {each.partition(".")[0] for each in sys.modules}
print(*{each.lower() for name in names for each in known.get(name, ())})
"""
"""Prints the packages of which the modules of a car's computer import something."""


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


def test_car_imports_only_what_the_script_installs() -> None:
    """On a car's computer, `fleet` and the gateway ended: msgspec was not installed there."""
    done = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, check=True)
    installed, wanted = set[str](), [*CAR_IMPORTS]
    while wanted:
        name = wanted.pop()
        if name not in installed:
            installed.add(name)
            needed = map(Requirement, metadata.requires(name) or ())
            wanted += [each.name.lower() for each in needed if each.marker is None or each.marker.evaluate()]
    # setuptools has a hook in each environment of it. msgspec imports typing_extensions if it is there.
    assert {*done.stdout.split()} - installed - {"setuptools", "typing_extensions"} == {"zenoh-car-fleet"}
