"""Each family passes the checks that a gateway relies on, and a careless driver does not."""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from gateway.control.commands import Action, AimServo, Find
from gateway.control.driver import Desk, Event
from gateway.drivers import Family, check
from gateway.drivers.plain_profile import PlainProfile
from gateway.drivers.waveshare import family as waveshare
from gateway.drivers.yahboom import family as yahboom
from schemas.words import Basis, Light, Motion
from tests.support import tank

FAMILIES = {"yahboom": yahboom, "waveshare": waveshare, "tank": tank}


@pytest.mark.parametrize(
    ("name", "platform"), [(name, platform) for name, family in FAMILIES.items() for platform in family.PLATFORMS]
)
def test_families_pass_driver_check(name: str, platform: str) -> None:
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


class NakedStop(tank.TankDriver):
    """Sends a stop that half a line spoils."""

    def stop_frame(self, index: int) -> bytes:
        del index
        return self.motion_frame(Motion.STOP)


class Centimeters(tank.TankDriver):
    """Publishes a distance in another unit."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {"sensor/range": {"range_m": 42.0}} if super().measured(event) else {}


class NoDistance(tank.TankDriver):
    """Publishes that there is no distance, but not why."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {"sensor/range": {}} if super().measured(event) else {}


class LosesBytes(tank.TankDriver):
    """Keeps a part of a line for itself."""

    def feed(self, data: bytes, now: float) -> list[Event]:
        events = super().feed(data, now)
        for event in events:
            if isinstance(event, tank.TankReport):
                event.raw = event.raw[1:]
        return events


class Aims(tank.TankDriver):
    """Turns a servo that its profile does not have."""

    def part_frames(self, what: Action) -> tuple[bytes, ...] | None:
        return (b'{"servo":90}\n',) if isinstance(what, AimServo) else None


class Misnames(tank.TankDriver):
    """Publishes a field that does not exist."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {topic: {"range": 1.0} for topic in super().measured(event)}


class OnlySays(tank.TankDriver):
    """Says that the car has a dead-man, and does not feed it."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk)
        self.model.profile = replace(tank.PROFILE, dead_man_s=5.0)


class Beats(tank.TankDriver):
    """Keeps its link alive, twice a second."""

    beat_at = 0.0

    def setup_at(self) -> float:
        return self.beat_at

    def setup_frame(self, now: float) -> bytes | None:
        if now < self.beat_at:
            return None
        self.beat_at = now + 0.5
        return b'{"beat":1}\n'


class BeatsOnly(Beats):
    """Says a dead-man, does not repeat its motions, and beats."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk)
        self.model.profile = replace(tank.PROFILE, dead_man_s=5.0)


class BeatsAsleep(Beats):
    """Asks for its beats, and does not say when they are due."""

    def setup_at(self) -> float:
        return float("inf")


class Never(Beats):
    """Has no frame of a stop."""

    STOP_FRAMES = 0


class OneSpeed(tank.TankDriver):
    """Drives at one speed."""

    def motion_frame(self, motion: Motion) -> bytes:
        speed, self.model.speed = self.model.speed, 1.0
        frame = super().motion_frame(motion)
        self.model.speed = speed
        return frame


class Turned(tank.TankDriver):
    """Drives ahead to go back."""

    def motion_frame(self, motion: Motion) -> bytes:
        return super().motion_frame(Motion.FORWARD if motion is Motion.BACK else motion)


class Promises(tank.TankDriver):
    """Says that it has lights."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk)
        self.model.profile = replace(tank.PROFILE, capabilities=tank.PROFILE.capabilities | {"light"})


class Waits(tank.TankDriver):
    """Is never ready."""

    def wait_words(self, now: float) -> str:
        return "the moon"


class Fails(tank.TankDriver):
    """Raises."""

    def measured(self, event: Event) -> dict[str, Any]:
        raise ZeroDivisionError


class Types(NakedStop):
    """Writes text, not bytes."""

    def motion_frame(self, motion: Motion) -> Any:
        return super().motion_frame(motion).decode()


class Texts(tank.TankDriver):
    """Publishes a number as text."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {topic: {name: str(each) for name, each in of.items()} for topic, of in super().measured(event).items()}


class AnyNumber(tank.TankDriver):
    """Publishes whatever float() makes of a report, and raises where it makes nothing."""

    def _event(self, line: bytes, now: float) -> Event:
        found = json.loads(line) if line.startswith(b'{"v"') else {"v": 0, "dist_cm": 0}
        return tank.TankReport(line, now, found["v"], found["dist_cm"])

    def measured(self, event: Event) -> dict[str, Any]:
        return {"sensor/battery": {"voltage_v": cast("tank.TankReport", event).volts}}


class Drops(tank.TankDriver):
    """Raises when its link is lost."""

    def drop_bytes(self) -> list[Event]:
        raise KeyError("half")


class Keeps(tank.TankDriver):
    """Keeps the unfinished line when the link is lost."""

    def drop_bytes(self) -> list[Event]:
        return []


class Unsaved(tank.TankDriver):
    """Would keep what is not JSON."""

    def kept(self) -> dict[str, Any]:
        return {"speeds": {1: 0.5}}


class Nulls(tank.TankDriver):
    """Publishes None for what was not measured."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {topic: dict.fromkeys(fields) for topic, fields in super().measured(event).items()}


class Flags(tank.TankDriver):
    """Publishes a number as True."""

    def measured(self, event: Event) -> dict[str, Any]:
        return {topic: dict.fromkeys(fields, True) for topic, fields in super().measured(event).items()}


class RefusesInBytes(tank.TankDriver):
    """Refuses in bytes."""

    def refusal(self, what: Any) -> Any:
        return (super().refusal(what) or "").encode() or None


class WaitsForNone(tank.TankDriver):
    """Says None if it waits for nothing."""

    def wait_words(self, now: float) -> Any:
        return None


class KeepsList(tank.TankDriver):
    """Would keep a list."""

    def kept(self) -> Any:
        return [1]


class LosesText(tank.TankDriver):
    """Counts in text."""

    lost_frames = cast("Any", "1")


class RestsByNoise(tank.TankDriver):
    """Takes anything that arrives for a report of a car that stands."""

    @property
    def can_show(self) -> bool:
        return True

    def on_event(self, event: Event, now: float) -> None:
        super().on_event(event, now)
        if not isinstance(event, tank.TankReport):
            self.show_rest("something arrives", now)


class RestsAlways(tank.TankDriver):
    """Takes any report for one of a car that stands."""

    @property
    def can_show(self) -> bool:
        return True

    def on_reading(self, event: Event, now: float) -> None:
        super().on_reading(event, now)
        self.show_rest("it reports", now)


class SwapsSpins(tank.TankDriver):
    """Spins to the wrong side."""

    def motion_frame(self, motion: Motion) -> bytes:
        swapped = {Motion.SPIN_LEFT: Motion.SPIN_RIGHT, Motion.SPIN_RIGHT: Motion.SPIN_LEFT}
        return super().motion_frame(swapped.get(motion, motion))


class TooFast(tank.TankDriver):
    """Drives at twice the speed."""

    def motion_frame(self, motion: Motion) -> bytes:
        before, self.model.speed = self.model.speed, 2 * self.model.speed
        frame = super().motion_frame(motion)
        self.model.speed = before
        return frame


class StopsLate(tank.TankDriver):
    """Drives with the first frame of a stop."""

    def stop_frame(self, index: int) -> bytes:
        return b'{"move":[0.1,0.1]}\n' if index == 0 else super().stop_frame(index)


class ShinesAhead(tank.TankDriver):
    """Drives when it shows which car it is."""

    def part_frames(self, what: Action) -> tuple[bytes, ...] | None:
        return (b'{"move":[0.1,0.1]}\n',) if isinstance(what, Find) else None


class Hides(tank.TankDriver):
    """Accepts to show which car it is, and has no frames for that."""

    def refusal(self, what: Action) -> str | None:
        return None if isinstance(what, Find) else super().refusal(what)


class Coasts(tank.TankDriver):
    """Writes nothing at the end of a drive."""

    def end_motion(self, now: float, pending: Any = None) -> None:
        del now, pending


class Hurries(tank.TankDriver):
    """Begins at half of its speed, whatever the fleet file says."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk)
        self.model.speed = 0.5


class Trusts(tank.TankDriver):
    """Takes a report of no distance for one of a car that stands, and never doubts it."""

    @property
    def can_show(self) -> bool:
        return True

    def on_reading(self, event: Event, now: float) -> None:
        if cast("tank.TankReport", event).dist_cm < 100:
            self.show_rest("it is near", now)


class Doubts(Trusts):
    """Takes a report of a great distance for one of a car that moves."""

    def on_reading(self, event: Event, now: float) -> None:
        super().on_reading(event, now)
        if cast("tank.TankReport", event).dist_cm > 100:
            self.model.turned_at = event.at


@pytest.mark.parametrize(
    ("driver", "fails"),
    [
        (Beats, set()),
        (Doubts, set()),
        (Trusts, {"check_rest"}),
        (SwapsSpins, {"check_wheels"}),
        (TooFast, {"check_wheels"}),
        (StopsLate, {"check_wheels"}),
        (ShinesAhead, {"check_wheels"}),
        (Hides, {"check_actions"}),
        (Coasts, {"check_drive"}),
        (Hurries, {"check_motions"}),
        (Types, {"check_connect", "check_drive", "check_bytes", "check_motions", "check_actions", "check_wheels"}),
        (Texts, {"check_samples", "check_hostile"}),
        (AnyNumber, {"check_hostile", "check_bytes", "check_rest"}),
        (Drops, {"check_loss"}),
        (Keeps, {"check_loss"}),
        (Unsaved, {"check_kept"}),
        (Nulls, {"check_samples", "check_hostile"}),
        (Flags, {"check_samples", "check_hostile"}),
        (RefusesInBytes, {"check_actions"}),
        (WaitsForNone, {"check_answers"}),
        (KeepsList, {"check_answers"}),
        (LosesText, {"check_answers"}),
        (RestsByNoise, {"check_rest"}),
        (RestsAlways, {"check_rest"}),
        (BeatsOnly, {"check_drive"}),
        (BeatsAsleep, {"check_connect", "check_drive"}),
        (Never, {"check_connect", "check_motions", "check_stop", "check_drive", "check_loss", "check_end"}),
        (OneSpeed, {"check_motions", "check_wheels"}),
        (Turned, {"check_motions", "check_wheels"}),
        (Promises, {"check_capabilities"}),
        (NakedStop, {"check_wheels"}),
        (Centimeters, {"check_samples"}),
        (NoDistance, {"check_samples"}),
        (LosesBytes, {"check_samples"}),
        (Aims, {"check_capabilities"}),
        (Waits, {"check_drive"}),
        (Fails, {"check_bytes", "check_samples", "check_hostile", "check_loss"}),
        (Talks, {"check_connect", "check_stop", "check_end", "check_rest"}),
        (Mute, {"check_connect", "check_stop", "check_loss", "check_end", "check_bytes", "check_drive"}),
        (Splits, {"check_bytes", "check_samples"}),
        (Empty, {"check_connect", "check_motions", "check_drive", "check_wheels"}),
        (Lacks, {"check_motions", "check_wheels"}),
        (Misnames, {"check_samples", "check_hostile"}),
        (OnlySays, {"check_drive"}),
    ],
)
def test_careless_driver_fails_driver_check(driver: Any, fails: set[str]) -> None:
    family = SimpleNamespace(
        PLATFORMS=("tank",),
        SAMPLES=tank.SAMPLES,
        MOVING=(b'{"v":7.9,"dist_cm":200}\n',),
        wheels_after=tank.wheels_after,
        profile_of=lambda name: replace(
            tank.profile_of(name), dead_man_s=5.0 if driver in (OnlySays, BeatsOnly) else None
        ),
        profiles=tank.profiles,
        driver_of=lambda name, kept: driver,
    )
    found = {name: faults for _, name, faults in check.check(cast("Family", family)) if faults}
    assert bool(found) is bool(fails)
    assert found.keys() <= fails, found


@pytest.mark.parametrize(
    ("names", "fails"),
    [(("tank",), False), (("small tank",), True), (("tänk",), True), (("t" * 33,), True), (("tank", "tank"), True)],
)
def test_platform_names_that_no_fleet_file_could_hold(names: tuple[str, ...], fails: bool) -> None:
    def profile_of(name: str) -> PlainProfile:
        if name not in names:
            raise ValueError(name)
        return replace(tank.PROFILE, name=name)

    family = SimpleNamespace(PLATFORMS=names, profiles=lambda: tuple(map(profile_of, names)), profile_of=profile_of)
    assert bool([*check.check_names(cast("Family", family), names[0])]) is fails


@pytest.mark.parametrize(
    ("changes", "fails"),
    [
        ({"PLATFORMS": "tank"}, {"check_names"}),
        ({"PLATFORMS": ()}, {"check_names"}),
        ({"PLATFORMS": ("Tank",)}, {"check_names", "check_profile"}),
        (
            {"PLATFORMS": ("arduino",), "profile_of": lambda name: replace(tank.PROFILE, name="arduino")},
            {"check_names"},
        ),
        ({"profiles": tuple}, {"check_names"}),
        ({"profile_of": {"tank": tank.PROFILE}.__getitem__}, {"check_names"}),
        ({"profile_of": lambda name: tank.PROFILE}, {"check_names"}),
        ({"profile_of": lambda name: replace(tank.profile_of(name), baud=cast("int", "115200"))}, {"check_profile"}),
        ({"profile_of": lambda name: replace(tank.profile_of(name), cells=0)}, {"check_profile"}),
        (
            {"profile_of": lambda name: replace(tank.profile_of(name), has_network=cast("bool", "no"))},
            {"check_profile"},
        ),
        (
            {"profile_of": lambda name: replace(tank.profile_of(name), hints=(("silent", cast("str", 1)),))},
            {"check_profile"},
        ),
        ({"profile_of": lambda name: replace(tank.profile_of(name), measures=frozenset({"range"}))}, {"check_samples"}),
        (
            {"profile_of": lambda name: replace(tank.profile_of(name), lights=frozenset({Light.RED}))},
            {"check_capabilities"},
        ),
        (
            {"profile_of": lambda name: replace(tank.profile_of(name), capabilities=frozenset({"drive", "mode"}))},
            {"check_capabilities"},
        ),
        (
            {"profile_of": lambda name: replace(tank.profile_of(name), capabilities=frozenset({"drives"}))},
            {"check_profile", "check_capabilities"},
        ),
    ],
)
def test_careless_family_fails_driver_check(changes: dict[str, Any], fails: set[str]) -> None:
    family = SimpleNamespace(**{**vars(tank), **changes})
    found = {name: faults for _, name, faults in check.check(cast("Family", family)) if faults}
    assert next(iter(fails)) in found or found.keys() & fails, found
    assert found.keys() <= fails | ({*dict.fromkeys(found)} if "PLATFORMS" in changes else set()), found


STANDS = b'{"T":1001,"L":0,"R":0,"odl":1,"odr":1,"v":1100}\n'
MOVES = b'{"T":1001,"L":0.2,"R":0.2,"odl":1,"odr":1,"v":1100}\n'


@pytest.mark.parametrize("platform", waveshare.PLATFORMS)
@pytest.mark.parametrize("moving", [(), (MOVES,), (STANDS,)])
def test_rest_shown_by_any_report_needs_moving_samples(platform: str, moving: tuple[bytes, ...]) -> None:
    family = SimpleNamespace(**vars(waveshare), SAMPLES=(STANDS,), MOVING=moving)
    bench = check.Bench(cast("Family", family), platform, (STANDS,))
    bench.control.link_up(bench.now)
    bench.run(30.0)
    can_show = bench.control.driver.model.basis is Basis.SHOWN
    assert bool(list(check.check_rest(cast("Family", family), platform))) is (can_show and moving != (MOVES,))
    assert not list(check.check_hostile(cast("Family", family), platform))


def test_flooding_driver_is_found() -> None:
    bench = check.Bench(cast("Family", SimpleNamespace(driver_of=lambda name, kept: Floods)), "tank")
    bench.control.link_up(bench.now)
    bench.run(1.0)
    assert any("frames at one moment" in each for each in bench.faults)


def test_check_finds_measurement_in_unmeasured_bytes() -> None:
    family = SimpleNamespace(**vars(tank), UNMEASURED=(b'{"v":0,"dist_cm":999}\n', b'{"v":7.9,"dist_cm":0}\n'))
    found = list(check.check_samples(cast("Family", family), "tank"))
    assert len(found) == 1
    assert "sensor/battery" in found[0]


def test_check_finds_line_with_three_sensors() -> None:
    class ThreeSensors(tank.TankDriver):
        def measured(self, event: Event) -> dict[str, Any]:
            return {"sensor/line": dict.fromkeys(("left_outer", "left_inner", "right_outer"), True)}

    family = SimpleNamespace(
        **{
            **vars(tank),
            "profile_of": lambda name: replace(tank.PROFILE, measures=frozenset({"line"})),
            "driver_of": lambda name, kept: ThreeSensors,
        }
    )
    (fault,) = check.check_samples(cast("Family", family), "tank")
    assert "no value for right_inner" in fault


def test_unmeasured_half_frame_does_not_spoil_samples() -> None:
    family = SimpleNamespace(**vars(tank), UNMEASURED=(b'{"v":7.9,"dist',))
    assert not list(check.check_samples(cast("Family", family), "tank"))


def test_one_mistake_is_told_once(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(tank.TankDriver, "STOPS_WITHIN_S")
    assert check.main(["tests.support.tank"]) == 1
    told = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    assert told["tank motions"].startswith("STOPS_WITHIN_S is missing")
    assert told["tank connect"] == "as in bytes"


def test_bench_of_the_page_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[3] / "docs/how-to/write-a-driver.md").read_text()
    (block,) = [each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Bench(" in each]
    monkeypatch.setitem(sys.modules, "my_tank", tank)
    scope: dict[str, Any] = {}
    exec(block, scope)
    assert any(b'"move": [0.5, 0.5]' in data for _, data, _ in scope["bench"].sent)


def test_driver_check_command_names_missing_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert check.main([]) == 2
    assert check.main(["no_such_module"]) == 2
    assert check.main(["json"]) == 2
    assert "PLATFORMS" in capsys.readouterr().err
    assert check.main(["tests.support.tank"]) == 0
    assert "tank stop: ok" in capsys.readouterr().out
