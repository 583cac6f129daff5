"""A platform finds its family: ours by a table, others by the entry point of their package."""

import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from gateway import drivers
from schemas.words import Mode
from tests.support import tank
from tests.support.driver_package import installed_driver
from tests.support.text_parts import has_parts


def test_built_in_platforms_have_profile_and_driver() -> None:
    assert {"arduino", "stm32", "raspberry_pi", "unknown", "wave_rover", "ugv_beast"} <= set(
        drivers.built_in_platforms()
    )
    for name in drivers.built_in_platforms():
        profile = drivers.profile_of(name)
        assert profile.name == name
        assert Mode.MANUAL in profile.modes
        assert callable(drivers.driver_of(name, {}))
    assert drivers.family_name("ugv02") == "waveshare"
    assert drivers.family_name("auto") == drivers.family_name("stm32+arm") == drivers.YAHBOOM


@pytest.mark.parametrize("name", ["ugv_rovr", "", "ugv_rover+arm", "+arm", "arduino+arn"])
def test_wrong_platform_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"Unknown (platform|option)"):
        drivers.check_platform(name)


def test_names_are_read_in_any_case() -> None:
    assert drivers.check_platform("UGV_Rover") == "ugv_rover"
    assert drivers.check_platform("Auto+Text") == "auto+text"
    assert [each.name for each in drivers.profiles_of("auto+arm")] == ["arduino+arm", "stm32+arm", "raspberry_pi+arm"]


def test_family_of_other_package_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with installed_driver(tmp_path, monkeypatch, "tests.support.tank"):
        assert "tank" in drivers.platforms()
        assert drivers.check_platform("tank") == "tank"
        assert drivers.profile_of("tank").measurable(Mode.MANUAL) == {"battery", "range"}


def test_hints_are_those_of_the_family(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert drivers.hint("tank", "silent") == "", "its driver is not installed"
    monkeypatch.setattr(tank, "PROFILE", replace(tank.PROFILE, hints=(("silent", "Is its turret locked?"),)))
    with installed_driver(tmp_path, monkeypatch, "tests.support.tank"):
        assert drivers.hint("tank", "silent") == "Is its turret locked?"
        assert drivers.hint("tank", "PV") == ""
        found = {name: drivers.hint(name, "silent") for name in drivers.built_in_platforms()}
    assert drivers.hint("", "silent") == found["unknown"] == found["arduino"] != ""
    assert found["ugv_rover"] == found["wave_rover"] not in ("", found["unknown"])


def test_all_profiles_include_installed_families(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with installed_driver(tmp_path, monkeypatch, "tests.support.tank"):
        assert [each.name for each in drivers.all_profiles()][-1] == "tank"
    monkeypatch.setattr(tank, "profiles", {}.popitem)
    with installed_driver(tmp_path / "again", monkeypatch, "tests.support.tank"):
        assert drivers.all_profiles() == drivers.built_in_profiles()
        assert has_parts(drivers.broken["tank"], "profiles() … KeyError")


@pytest.mark.parametrize("text", ["import sys; sys.exit(3)", "PLATFORMS = ('tank',)"], ids=["ends", "lacks"])
def test_package_that_is_no_driver_is_named(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "no_driver.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "no_driver", raising=False)
    with installed_driver(tmp_path, monkeypatch, "no_driver"):
        assert drivers.platforms() == drivers.built_in_platforms()
        assert "no_driver" in drivers.broken["tank"]


def test_package_that_fails_is_named_and_others_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with installed_driver(tmp_path, monkeypatch, "no_such_package.driver"):
        assert drivers.profile_of("ugv02").name == "ugv02"
        with pytest.raises(ValueError, match=r"Unknown platform .*tank.* no_such_package"):
            drivers.profile_of("tank")
