"""What a user may write, and the one-line errors for what not."""

import pytest

from gateway.sim.spec import (
    BadSpec,
    CarSpec,
    Fault,
    FaultKind,
    PtyLink,
    Scheduled,
    TcpLink,
    fault_of,
    parse_car,
    parse_cars,
    parse_fault,
)

GOOD_CARS = [
    ("red:arduino:pty", CarSpec("red", "arduino", frozenset(), PtyLink())),
    ("r2_d-2:stm32+arm+imu:pty:/tmp/x", CarSpec("r2_d-2", "stm32", frozenset({"arm", "imu"}), PtyLink("/tmp/x"))),
    ("blue:raspberry_pi:tcp://127.0.0.1:0", CarSpec("blue", "raspberry_pi", frozenset(), TcpLink("127.0.0.1", 0))),
    ("blue:raspberry_pi:tcp", CarSpec("blue", "raspberry_pi", frozenset(), TcpLink())),
    ("blue:arduino:tcp://[::1]:8888", CarSpec("blue", "arduino", frozenset(), TcpLink("::1", 8888))),
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


GOOD_FAULTS = [
    ("red:link_drop@5+2", Scheduled(5.0, Fault(FaultKind.LINK_DROP, "red", 2.0))),
    ("link_drop@0.5", Scheduled(0.5, Fault(FaultKind.LINK_DROP))),
    ("red:garbage@3+200", Scheduled(3.0, Fault(FaultKind.GARBAGE, "red", bytes=200))),
    ("brownout@10", Scheduled(10.0, Fault(FaultKind.BROWNOUT))),
]


@pytest.mark.parametrize(("text", "scheduled"), GOOD_FAULTS)
def test_scheduled_faults(text: str, scheduled: Scheduled) -> None:
    assert parse_fault(text) == scheduled


BAD_SCHEDULES = [
    ("link_drop", "[CAR:]FAULT@SECONDS"),
    ("link_drop@-1", "[CAR:]FAULT@SECONDS"),
    ("link_drop@x", "[CAR:]FAULT@SECONDS"),
    ("melt@1", "link_drop, garbage, brownout"),
    ("brownout@1+2", "takes no amount"),
    ("garbage@1+0", "1 to 100000"),
    ("link_drop@1+9999999", "0 to 86400"),
    ("link_drop@9999999", "86400"),
]


@pytest.mark.parametrize(("text", "words"), BAD_SCHEDULES)
def test_bad_scheduled_faults(text: str, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        parse_fault(text)
    assert words in str(error.value)


BAD_FAULTS: list[tuple[object, str]] = [
    ([], "one JSON object"),
    ({}, "link_drop, garbage, brownout"),
    ({"fault": 3}, "link_drop, garbage, brownout"),
    ({"fault": "brownout", "for_s": 2}, "'for_s'"),
    ({"fault": "link_drop", "for_s": "2"}, "0 to 86400"),
    ({"fault": "link_drop", "for_s": float("nan")}, "0 to 86400"),
    ({"fault": "link_drop", "for_s": True}, "0 to 86400"),
    ({"fault": "garbage", "bytes": 10**9}, "1 to 100000"),
    ({"fault": "garbage", "to": "moon"}, "host or car"),
    ({"fault": "garbage", "car": 7}, "car 7"),
]


@pytest.mark.parametrize(("fields", "words"), BAD_FAULTS)
def test_bad_faults(fields: object, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        fault_of(fields)
    assert words in str(error.value)
