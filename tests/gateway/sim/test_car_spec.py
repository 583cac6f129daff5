"""Descriptions of cars on the command line, and one-line errors for invalid ones."""

import pytest

from gateway.sim.car_spec import BadSpec, CarSpec, PtyPath, ReplaySpec, TcpListen, parse_car, parse_cars, parse_replay

GOOD_CARS = [
    ("red:arduino:pty", CarSpec("red", "arduino", frozenset(), PtyPath())),
    ("r2_d-2:stm32+arm+imu:pty:/tmp/x", CarSpec("r2_d-2", "stm32", frozenset({"arm", "imu"}), PtyPath("/tmp/x"))),
    ("blue:raspberry_pi:tcp://127.0.0.1:0", CarSpec("blue", "raspberry_pi", frozenset(), TcpListen("127.0.0.1", 0))),
    ("blue:raspberry_pi:tcp", CarSpec("blue", "raspberry_pi", frozenset(), TcpListen())),
    ("blue:arduino:tcp://[::1]:8888", CarSpec("blue", "arduino", frozenset(), TcpListen("::1", 8888))),
]


@pytest.mark.parametrize(("text", "spec"), GOOD_CARS)
def test_cars(text: str, spec: CarSpec) -> None:
    assert parse_car(text) == spec


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
