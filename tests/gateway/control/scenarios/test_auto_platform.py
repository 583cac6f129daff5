"""With `--platform auto`, a car is unknown at first. Its bytes settle the platform, and with it the kind of stop."""

import json

import pytest
from msgspec.structs import replace

from gateway.control.commands import Drive, SetMode, Stop
from gateway.control.driver import Event
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.protocol.modes import EVERY_MEASUREMENT
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.sim.model.raspberry_pi import Transport
from gateway.sim.model.stm32 import STM32_TRAITS
from gateway.sim.model.traits import CarTraits
from schemas.platform_name import parse_option
from schemas.words import Mode, Motion, Platform, Shows
from tests.support.controls import control
from tests.support.virtual import Pair


def paired(platform: str, *, traits: CarTraits | None = None) -> Pair:
    transport = Transport.TCP if platform == "raspberry_pi" else Transport.SERIAL
    pair = Pair(platform, transport=transport, traits=traits)
    name, auto = parse_option("auto")
    pair.control = control(parse_platform(name), auto=auto)
    pair.connect()
    return pair


@pytest.mark.parametrize(
    ("platform", "settled", "first"),
    [
        ("arduino", "arduino", b"$4WD,MODE00#"),
        ("stm32", "stm32", b"$0,0,0,0,0,0,0,0,0#"),
        ("raspberry_pi", "raspberry_pi", b"$0,0,0,0,0,0,0,0,0#"),
    ],
)
def test_auto_platform_detects_and_stops_each_car(platform: str, settled: str, first: bytes) -> None:
    pair = paired(platform)
    assert pair.control.driver.model.profile.name == "unknown"
    pair.until(lambda: pair.control.driver.model.known, 20.0)
    assert pair.sent[0][1] == b"$0,0,0,0,0,0,0,0,0#", "not knowing what it is, the frame that every car obeys first"
    pair.until(lambda: pair.control.driver.model.profile.name == settled, 10.0)
    assert any(log.code == "platform_settled" and settled in log.words for log in pair.logs)
    assert settled in pair.control.driver.model.platform.evidence[0]
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.run(1.9)
    pair.sent.clear()
    answer = pair.ask(Stop())
    assert answer.worst_case_s < 2.2
    pair.run(4.0)
    assert first in [data for _, data in pair.sent]
    assert pair.off_for_good_at()


def published(pair: Pair, seconds: float) -> list[set[str]]:
    """Let time pass. Return the topics of each reading that a gateway publishes."""
    found: list[set[str]] = []
    driver = pair.control.driver
    heard = driver.on_event

    def publishing(event: Event, now: float) -> None:
        found.append({topic.removeprefix("sensor/") for topic in driver.measured(event)})
        heard(event, now)

    driver.on_event = publishing  # type: ignore[method-assign]  # where link_loop.py publishes an event
    pair.run(seconds)
    return found


def test_constants_of_stm32_that_counts_as_arduino_are_not_published() -> None:
    """The car stands on its line, and its constants say that it sees none."""
    pair = paired("stm32", traits=replace(STM32_TRAITS, constants=True))
    assert any(pair.car._body.line(pair.now))
    found = published(pair, 30.0)
    assert pair.control.driver.model.profile.name == "arduino"
    assert len(found) > 20
    assert all(each == {"range", "battery"} for each in found)


def test_all_fields_of_a_car_without_constants_are_published_at_once() -> None:
    assert all(each == EVERY_MEASUREMENT for each in published(paired("stm32"), 5.0))


def test_zeros_of_arduino_are_measurements_once_it_has_shown_a_stop() -> None:
    """Its report may have the text of the constants because there is nothing to see."""
    pair = paired("arduino", traits=CarTraits(constants=True))
    found = published(pair, 30.0)
    assert pair.control.driver.model.learned.shows is Shows.YES
    assert (found[0], found[-1]) == ({"range", "battery"}, EVERY_MEASUREMENT)


def test_undetected_platform_gets_only_common_frames() -> None:
    pair = paired("arduino")
    assert pair.ask(SetMode(Mode.TRACKING)).reason == "unsupported"
    pair.until(lambda: pair.control.driver.model.profile.name == "arduino", 20.0)
    assert pair.ask(SetMode(Mode.TRACKING)).reason is None


def test_returning_link_may_have_another_car() -> None:
    pair = paired("arduino")
    pair.until(lambda: pair.control.driver.model.profile.name == "arduino", 20.0)
    pair.control.driver.link_down("unplugged", pair.now)
    other = Pair("raspberry_pi", transport=Transport.TCP)
    other.control = pair.control
    other.run(pair.now, linked=False)
    other.connect()
    assert other.control.driver.model.profile.name == "unknown"
    other.until(lambda: other.control.driver.model.profile.name == "raspberry_pi", 30.0)


def in_a_silent_mode(platform: str, mode: Mode) -> Pair:
    pair = paired(platform)
    pair.until(lambda: pair.control.driver.model.profile.kind is not Platform.UNKNOWN, 20.0)
    pair.until(lambda: pair.control.is_free(pair.now), 20.0)
    pair.ask(SetMode(mode))
    pair.until(lambda: pair.car.truth.driving, 20.0)
    return pair


@pytest.mark.parametrize("gateway", ["the same", "another"])
@pytest.mark.parametrize(
    ("platform", "mode"), [("arduino", Mode.OBSTACLE_AVOIDANCE), ("stm32", Mode.TRACKING)], ids=["arduino", "stm32"]
)
def test_car_left_in_silent_mode_is_stopped_as_its_platform(platform: str, mode: Mode, gateway: str) -> None:
    pair = in_a_silent_mode(platform, mode)
    if gateway == "the same":
        pair.control.driver.link_down("unplugged", pair.now)
    else:
        kept = json.loads(json.dumps(pair.control.driver.model.learned.kept()))
        pair.control = control(parse_platform("unknown"), auto=True, learned=Learned.restore(kept))
    pair.run(1.0, linked=False)
    pair.connect()
    pair.until(lambda: not pair.car.truth.driving, 8.0)
    pair.run(5.0)
    assert not pair.car.truth.driving
    assert pair.control.driver.model.learned.opened_as == "", "a report has shown mode 0"


def test_platform_is_forgotten_if_link_ends_after_mode_frame() -> None:
    """Behind the same address there may be a program that ends at a mode frame now. It must not end again and again."""
    pair = in_a_silent_mode("arduino", Mode.OBSTACLE_AVOIDANCE)
    pair.control.driver.link_down("unplugged", pair.now)
    pair.car.feed = lambda *_: None  # type: ignore[method-assign]
    for counted in (1, 0, 0):
        pair.sent.clear()
        pair.connect()
        pair.run(6.0)
        assert min(1, sum(b"MODE00" in data for _, data in pair.sent)) == counted
        pair.control.driver.link_down("closed", pair.now)


def test_contradicted_profile_is_told_of_once() -> None:
    pair = Pair("raspberry_pi", told="arduino", transport=Transport.SERIAL)
    pair.connect()
    pair.run(30.0)
    told = [log for log in pair.logs if log.code == "platform_contradicted"]
    assert told
    assert len({log.words for log in told}) == len(told)
    assert parse_platform("arduino").name == pair.control.driver.model.profile.name, "what was told stays"
