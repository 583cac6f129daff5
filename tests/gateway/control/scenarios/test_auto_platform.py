"""With `--platform auto`, a car is unknown at first. Its bytes settle the platform, and with it the kind of stop."""

import pytest

from gateway.control.commands import Drive, SetMode, Stop
from gateway.control.controller import Controller
from gateway.protocol.enums import Mode, Motion
from gateway.protocol.platforms import parse_platform, parse_platform_option
from gateway.sim.model.raspberry_pi import Transport
from tests.support.virtual import Pair


def paired(platform: str) -> Pair:
    transport = Transport.TCP if platform == "raspberry_pi" else Transport.SERIAL
    pair = Pair(platform, transport=transport)
    profile, auto = parse_platform_option("auto")
    pair.control = Controller("red", profile, auto=auto)
    pair.connect()
    return pair


@pytest.mark.parametrize(
    ("platform", "settled", "first"),
    [
        ("arduino", "arduino", b"$4WD,MODE00#"),
        ("stm32", "arduino", b"$4WD,MODE00#"),
        ("raspberry_pi", "raspberry_pi", b"$0,0,0,0,0,0,0,0,0#"),
    ],
)
def test_a_car_is_found_out_and_stopped_as_what_it_is(platform: str, settled: str, first: bytes) -> None:
    pair = paired(platform)
    assert pair.control.model.profile.name == "unknown"
    pair.until(lambda: pair.control.model.known, 20.0)
    assert pair.sent[0][1] == b"$0,0,0,0,0,0,0,0,0#", "not knowing what it is, the frame that every car obeys first"
    pair.until(lambda: pair.control.model.profile.name == settled, 10.0)
    assert any(log.code == "platform_settled" and settled in log.words for log in pair.logs)
    assert settled in pair.control.model.platform.evidence[0]
    pair.ask(Drive(Motion.FORWARD, 5.0))
    pair.run(1.9)
    pair.sent.clear()
    answer = pair.ask(Stop())
    assert answer.worst_case_s < 1.2
    pair.run(4.0)
    assert pair.sent[0][1] == first
    assert pair.off_for_good_at()


def test_before_it_is_settled_only_what_every_car_knows_is_sent() -> None:
    pair = paired("arduino")
    assert pair.ask(SetMode(Mode.TRACKING)).reason == "unsupported"
    pair.until(lambda: pair.control.model.profile.name == "arduino", 20.0)
    assert pair.ask(SetMode(Mode.TRACKING)).reason is None


def test_a_link_that_comes_back_may_have_another_car_behind_it() -> None:
    pair = paired("arduino")
    pair.until(lambda: pair.control.model.profile.name == "arduino", 20.0)
    pair.control.link_down("unplugged", pair.now)
    other = Pair("raspberry_pi", transport=Transport.TCP)
    other.control = pair.control
    other.run(pair.now, linked=False)
    other.connect()
    assert other.control.model.profile.name == "unknown"
    other.until(lambda: other.control.model.profile.name == "raspberry_pi", 30.0)


@pytest.mark.parametrize(("told", "name"), [("auto", "unknown"), ("auto+arm", "unknown+arm"), ("stm32", "stm32")])
def test_auto_is_the_unknown_platform_until_then(told: str, name: str) -> None:
    profile, auto = parse_platform_option(told)
    assert (profile.name, auto) == (name, told.startswith("auto"))


def test_a_platform_that_is_none_says_which_there_are() -> None:
    with pytest.raises(ValueError, match=r'Unknown platform "uno"\. .* Leave it out to detect it\.'):
        parse_platform_option("uno")


def test_a_contradicted_profile_is_told_of_once() -> None:
    pair = Pair("raspberry_pi", told="arduino", transport=Transport.SERIAL)
    pair.connect()
    pair.run(30.0)
    told = [log for log in pair.logs if log.code == "platform_contradicted"]
    assert told
    assert len({log.words for log in told}) == len(told)
    assert parse_platform("arduino").name == pair.control.model.profile.name, "what was told stays"
