"""The sums of connections and notifications of each Bluetooth adapter, and the warning of `fleet check`."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fleet.commands.check import check
from fleet.fleet_links import FleetLink, parse_fleet_link
from fleet.fleetfile import adapter_check
from fleet.fleetfile.adapter_check import AdapterCheck, check_adapters, list_adapters
from tests.support.ports import free_endpoint


def links(**adapters: str) -> dict[str, FleetLink]:
    """Return the links of Bluetooth cars; the option of each link is given."""
    return {
        car: parse_fleet_link(f"ble://AA:BB:CC:DD:EE:{number:02X}{option}")
        for number, (car, option) in enumerate(adapters.items())
    }


def sums(cars: dict[str, FleetLink], *adapters: str) -> dict[str, AdapterCheck]:
    return {each.adapter: each for each in check_adapters(cars, adapters)}


def test_cars_are_added_up_by_adapter() -> None:
    cars = links(a="", b="?adapter=hci0", c="?adapter=hci1")
    cars |= {"d": parse_fleet_link("sim"), "e": parse_fleet_link("/dev/ttyUSB0")}
    found = sums(cars, "hci0", "hci1")
    assert found == {
        "hci0": AdapterCheck("hci0", ("a", "b"), 2, 162, is_crowded=False, words="2 cars connect through it"),
        "hci1": AdapterCheck("hci1", ("c",), 1, 81, is_crowded=False, words="1 car connects through it"),
    }
    assert list(sums(cars)) == ["the first adapter", "hci0", "hci1"], "the adapters are not known here"
    assert sums({"e": cars["e"]}, "hci0") == {}


@pytest.mark.parametrize(
    ("count", "crowded", "words"),
    [
        (2, False, ""),
        (3, True, "; all in tracking, they send up to 243 notifications a second, and an adapter carries 165"),
        (4, True, "; most adapters take 5 connections, some 3; all in tracking, they send up to 324 "),
        (6, True, "an adapter carries 165; plug in another adapter, and write ?adapter=auto into the links"),
    ],
)
def test_too_many_are_warned_of_with_the_sum(count: int, crowded: bool, words: str) -> None:
    (found,) = check_adapters(links(**{f"car{number}": "" for number in range(count)}), ["hci0"])
    assert found.connections == count
    assert found.is_crowded is crowded
    assert found.words.startswith(f"{count} cars ")
    assert words in found.words


def test_auto_shares_adapters_with_cars_that_name_one() -> None:
    eight = links(**{f"car{number}": "?adapter=auto" for number in range(7)}, fixed="?adapter=hci1")
    found = sums(eight, "hci0", "hci1")
    assert found["auto"].connections == 8
    assert found["auto"].words.startswith("8 cars ")
    assert "2 adapters; " in found["auto"].words
    assert "plug in" not in found["auto"].words
    assert "another adapter" in sums(eight, "hci0")["auto"].words
    assert found["hci1"].connections == 1


def test_adapters_of_the_computer(tmp_path: Path) -> None:
    for name in ("hci10", "hci1", "hci0", "hci0:71"):
        (tmp_path / name).mkdir()
    assert list_adapters(tmp_path) == ["hci0", "hci1", "hci10"]
    assert list_adapters(tmp_path / "none") == []


def test_command_warns_and_finds_no_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "adapters" / "hci0").mkdir(parents=True)
    monkeypatch.setattr(adapter_check, "ADAPTERS", tmp_path / "adapters")
    monkeypatch.setenv("FLEET_ENDPOINT", free_endpoint())
    file = tmp_path / "fleet.yaml"
    file.write_text(json.dumps({"cars": {f"car{n}": {"link": f"ble://AA:BB:CC:DD:EE:{n:02X}"} for n in range(6)}}))
    done = CliRunner().invoke(check, [str(file)])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1].startswith("hci0  warn   6 cars ")
    told = json.loads(CliRunner().invoke(check, [str(file), "--json"]).stdout.splitlines()[-1])
    assert (told["adapter"], told["connections"], told["notifications_per_s"]) == ("hci0", 6, 486)
