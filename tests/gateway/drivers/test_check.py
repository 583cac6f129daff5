"""Each family passes the checks that a gateway relies on, and a careless driver does not."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gateway.control.driver import Desk, Event
from gateway.drivers import Family, check
from gateway.drivers.waveshare import family as waveshare
from gateway.drivers.yahboom import family as yahboom
from schemas.words import Motion
from tests.support import tank

FAMILIES = {"yahboom": yahboom, "waveshare": waveshare, "tank": tank}


@pytest.mark.parametrize(
    ("name", "platform"), [(name, platform) for name, family in FAMILIES.items() for platform in family.PLATFORMS]
)
def test_a_family_passes_every_check(name: str, platform: str) -> None:
    family = cast("Family", FAMILIES[name])
    found = {each.__name__: list(each(family, platform)) for each in check.CHECKS}
    assert found == {each.__name__: [] for each in check.CHECKS}


class Talks(tank.TankDriver):
    """Says that a silent car stands."""

    def tick(self, now: float) -> None:
        super().tick(now)
        self.show_rest("it must stand by now", now)


class Mute(tank.TankDriver):
    """Writes nothing."""

    def poll(self, now: float) -> None:
        del now


class Floods(tank.TankDriver):
    """Wants to write again and again."""

    def setup_frame(self, now: float) -> bytes:
        del now
        return b"{}\n"


class Splits(tank.TankDriver):
    """Takes each piece for a line."""

    def feed(self, data: bytes, now: float) -> list[Event]:
        return [self._event(data, now)] if data else []


class Empty(tank.TankDriver):
    """Stops with nothing."""

    def stop_frame(self, index: int) -> bytes:
        del index
        return b""


class Lacks(tank.TankDriver):
    """Knows no way to the right."""

    def motion_frame(self, motion: Motion) -> bytes:
        known: dict[Motion, Motion] = {each: each for each in Motion if each is not Motion.RIGHT}
        return super().motion_frame(known[motion])


class Misnames(tank.TankDriver):
    """Publishes a field that does not exist."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {topic: {"range": 1.0} for topic in super().measured(event)}


class OnlySays(tank.TankDriver):
    """Says that the car has a dead-man, and does not feed it."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk)
        self.model.profile = replace(tank.PROFILE, dead_man_s=5.0)


@pytest.mark.parametrize(
    ("driver", "fails"),
    [
        (Talks, {"check_connect", "check_stop", "check_end"}),
        (Mute, {"check_connect", "check_stop", "check_loss", "check_end", "check_bytes", "check_drive"}),
        (Splits, {"check_bytes", "check_samples"}),
        (Empty, {"check_connect", "check_motions", "check_drive"}),
        (Lacks, {"check_motions"}),
        (Misnames, {"check_samples"}),
        (OnlySays, {"check_drive"}),
    ],
)
def test_a_careless_driver_fails(driver: Any, fails: set[str]) -> None:
    family = SimpleNamespace(
        PLATFORMS=("tank",),
        SAMPLES=tank.SAMPLES,
        profile_of=lambda name: replace(tank.profile_of(name), dead_man_s=5.0 if driver is OnlySays else None),
        profiles=tank.profiles,
        driver_of=lambda name, kept: driver,
    )
    found = set()
    for each in check.CHECKS:
        try:
            if list(each(cast("Family", family), "tank")):
                found.add(each.__name__)
        except ValueError:  # a driver that writes nothing has no bytes to try
            found.add(each.__name__)
    assert found & fails
    assert found <= fails


def test_a_driver_that_floods_is_found() -> None:
    bench = check.Bench(cast("Family", SimpleNamespace(driver_of=lambda name, kept: Floods)), "tank")
    bench.control.link_up(bench.now)
    bench.run(1.0)
    assert any("frames at one moment" in each for each in bench.faults)


def test_the_command_names_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert check.main([]) == 2
    assert check.main(["no_such_module"]) == 2
    assert check.main(["json"]) == 2
    assert "PLATFORMS" in capsys.readouterr().err
    assert check.main(["tests.support.tank"]) == 0
    assert "tank stop: ok" in capsys.readouterr().out
