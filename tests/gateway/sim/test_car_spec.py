"""Descriptions of cars on the command line, and one-line errors for invalid ones."""

import pytest
from msgspec.structs import replace

from gateway.sim.car_spec import BadSpec, CarSpec, PtyPath, ReplaySpec, TcpListen, parse_car, parse_cars, parse_replay
from gateway.sim.model.stm32 import STM32_TRAITS
from gateway.sim.model.traits import CarTraits
from schemas.platform_name import OPTIONS, VARIANTS, parse_name
from schemas.words import Mode, Platform

GOOD_CARS = [
    ("red:arduino:pty", CarSpec("red", "arduino", frozenset(), PtyPath())),
    ("r2_d-2:stm32+arm+imu:pty:/tmp/x", CarSpec("r2_d-2", "stm32", frozenset({"arm", "imu"}), PtyPath("/tmp/x"))),
    ("blue:raspberry_pi:tcp://127.0.0.1:0", CarSpec("blue", "raspberry_pi", frozenset(), TcpListen("127.0.0.1", 0))),
    ("blue:raspberry_pi:tcp", CarSpec("blue", "raspberry_pi", frozenset(), TcpListen())),
    ("blue:arduino:tcp://[::1]:8888", CarSpec("blue", "arduino", frozenset(), TcpListen("::1", 8888))),
    ("blue:course:tcp", CarSpec("blue", "course", frozenset(), TcpListen())),
]


@pytest.mark.parametrize(("text", "spec"), GOOD_CARS)
def test_cars(text: str, spec: CarSpec) -> None:
    assert parse_car(text) == spec


TRAITS = [
    ("arduino+arm", None),
    ("arduino+text", CarTraits(text=True)),
    ("arduino+no_readings", CarTraits(readings=False)),
    ("arduino+3s", CarTraits(cells=3)),
    ("arduino+fan_level", CarTraits(fan_level=True)),
    ("arduino+ptz_direct", CarTraits(ptz_direct=True)),
    ("arduino+head=BaLa", CarTraits(head="BaLa")),
    ("arduino+interval=0.71+spread=0.08", CarTraits(interval_s=0.71, spread_s=0.08)),
    ("arduino+spread=0.08+interval=0.1", CarTraits(interval_s=0.1, spread_s=0.08)),
    ("arduino+timer", CarTraits(timer=True)),
    ("arduino+close=0", CarTraits(close_s=0.0)),
    ("arduino+last_frame", CarTraits(last_frame_wins=True)),
    ("arduino+silent=tracking+silent=following", CarTraits(silent_modes=frozenset({Mode.TRACKING, Mode.FOLLOWING}))),
    ("arduino+gray=4095", CarTraits(gray_max=4095)),
    ("arduino+constants", CarTraits(constants=True)),
    ("stm32", None),
    ("stm32+constants+3s", replace(STM32_TRAITS, constants=True, cells=3)),
    ("raspberry_pi+text+interval=2", CarTraits(text=True, interval_s=2.0)),
]


@pytest.mark.parametrize(("platform", "traits"), TRAITS)
def test_options_are_traits(platform: str, traits: CarTraits | None) -> None:
    spec = parse_car(f"red:{platform}:pty")
    assert spec.traits == traits
    assert sorted(spec.platform_words.split("+")) == sorted(platform.split("+"))


@pytest.mark.parametrize("platform", sorted(set(Platform) - {Platform.UNKNOWN}))
@pytest.mark.parametrize("option", [*sorted(OPTIONS), *VARIANTS, "head=BaLa"])
def test_each_option_of_a_platform_is_one_of_the_simulator(platform: str, option: str) -> None:
    # `fleet up --sim` gives a platform of the fleet file to the gateway and to the simulator.
    assert (parse_car(f"red:{platform}+{option}:pty").traits is not None) == (option not in OPTIONS)
    assert parse_name(f"{platform}+{option}")


BAD_CARS = [
    (["red"], "NAME:PLATFORM:LINK"),
    (["red:arduino"], "NAME:PLATFORM:LINK"),
    (["Red:arduino:pty"], "a-z"),
    ([":arduino:pty"], "a-z"),
    (["-red:arduino:pty"], "a-z"),
    (["a" * 33 + ":arduino:pty"], "1 to 32"),
    (["re/d:arduino:pty"], "a-z"),
    (["red:avr:pty"], "arduino, stm32, raspberry_pi"),
    (["red:Arduino:pty"], "arduino, stm32, raspberry_pi"),
    (["red:arduino+legs:pty"], "+arm, +imu"),
    (["red:arduino+:pty"], "+arm, +imu"),
    (["red:arduino+text=1:pty"], "+text,"),
    (["red:arduino+interval:pty"], "+interval=S"),
    (["red:arduino+interval=fast:pty"], "a number of seconds from 0.1 to 10"),
    (["red:arduino+interval=nan:pty"], "a number of seconds from 0.1 to 10"),
    (["red:arduino+interval=0.05:pty"], "a number of seconds from 0.1 to 10"),
    (["red:arduino+spread=1.1:pty"], "a number of seconds from 0 to 1"),
    (["red:arduino+interval=0.5+spread=0.5:pty"], "less than the interval, 0.5 s"),
    (["red:arduino+close=-1:pty"], "a number of seconds from 0 to 10"),
    (["red:arduino+gray=0.5:pty"], "a whole number from 1 to 65535"),
    (["red:arduino+silent=driving:pty"], "manual, remote_control, tracking"),
    (["red:arduino+head=A:pty"], "2 to 8 letters and digits"),
    (["red:arduino+head=AA+head=BB:pty"], "'+head' is given twice"),
    (["red:arduino+interval=1+text+interval=2:pty"], "'+interval' is given twice"),
    (["red:ugv_rover+arm+gimbal:pty"], "+arm or +gimbal"),
    (["red:stm32+timer:pty"], "option '+timer' of stm32 is not allowed: use +arm, +imu"),
    (["red:raspberry_pi+gray=4095:pty"], "use +arm, +imu"),
    (["red:course+arm:pty"], "use none"),
    (["red:arduino:usb"], "pty, pty:PATH"),
    (["red:arduino:pty:"], "pty, pty:PATH"),
    (["red:arduino:"], "pty, pty:PATH"),
    (["red:arduino:tcp://127.0.0.1"], "tcp://HOST:PORT"),
    (["red:arduino:tcp://127.0.0.1:"], "tcp://HOST:PORT"),
    (["red:arduino:tcp://127.0.0.1:65536"], "0 to 65535"),
    (["red:arduino:tcp://:80"], "tcp://HOST:PORT"),
    (["red:arduino:pty", "red:arduino:tcp"], "two cars have the name red"),
    (["a:arduino:pty:/x", "b:arduino:pty:/x"], "two cars have the path /x"),
    (["a:arduino:tcp://h:80", "b:arduino:tcp://h:80"], "two cars have the port h:80"),
]


@pytest.mark.parametrize(("texts", "words"), BAD_CARS)
def test_bad_cars(texts: list[str], words: str) -> None:
    with pytest.raises(BadSpec) as error:
        parse_cars(texts)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


REPLAYS = [
    ("red.raw", ReplaySpec("replay", "red.raw", PtyPath())),
    ("red.raw:red", ReplaySpec("red", "red.raw", PtyPath())),
    ("/a/b:c.raw:red", ReplaySpec("red", "/a/b:c.raw", PtyPath())),
    ("red.raw:red:pty:/tmp/red", ReplaySpec("red", "red.raw", PtyPath("/tmp/red"))),
    ("red.raw:red:tcp", ReplaySpec("red", "red.raw", TcpListen())),
    ("red.raw:red:tcp://127.0.0.1:80", ReplaySpec("red", "red.raw", TcpListen("127.0.0.1", 80))),
]


@pytest.mark.parametrize(("text", "spec"), REPLAYS)
def test_replays(text: str, spec: ReplaySpec) -> None:
    assert parse_replay(text) == spec


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "FILE[:NAME[:LINK]]"),
        ("x:" + "a" * 33, "1 to 32"),
        ("x:-a", "a-z"),
        ("x:red:tcp://h:99999", "tcp://HOST:PORT"),
    ],
)
def test_bad_replays(text: str, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        parse_replay(text)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
