"""Descriptions of faults, and one-line errors for invalid ones."""

import pytest

from gateway.sim.car_spec import BadSpec, CarSpec, ReplaySpec, parse_car, parse_replay
from gateway.sim.cli import EPILOG
from gateway.sim.faults import (
    Fault,
    FaultKind,
    Press,
    Scheduled,
    fault_of,
    parse_fault,
    parse_press,
    press_of,
    targets,
)
from gateway.sim.model.faulty_link import Direction, Flood
from gateway.sim.model.ir_remote import Button
from tests.support.text_parts import has_parts

GOOD_FAULTS = [
    ("red:link_drop@5+2", Scheduled(5.0, Fault(FaultKind.LINK_DROP, "red", 2.0))),
    ("link_drop@0.5", Scheduled(0.5, Fault(FaultKind.LINK_DROP))),
    ("red:garbage@3+200", Scheduled(3.0, Fault(FaultKind.GARBAGE, "red", bytes=200, ways=(Direction.TO_HOST,)))),
    ("garbage@3,to=car", Scheduled(3.0, Fault(FaultKind.GARBAGE, bytes=100, ways=(Direction.TO_CAR,)))),
    ("red:rename@1", Scheduled(1.0, Fault(FaultKind.RENAME, "red", 1.0))),
    ("red:rename@1+2,path=/x:y", Scheduled(1.0, Fault(FaultKind.RENAME, "red", 2.0, path="/x:y"))),
    ("red:cut_write@1+2,bytes=0", Scheduled(1.0, Fault(FaultKind.CUT_WRITE, "red", 2.0, bytes=0))),
    ("slow@1+2", Scheduled(1.0, Fault(FaultKind.SLOW, for_s=2.0, factor=0.1))),
    ("slow@1,factor=1e-2", Scheduled(1.0, Fault(FaultKind.SLOW, factor=0.01))),
    ("lossy@1,share=0.5,to=car", Scheduled(1.0, Fault(FaultKind.LOSSY, share=0.5, ways=(Direction.TO_CAR,)))),
    ("stuck@1+0", Scheduled(1.0, Fault(FaultKind.STUCK, for_s=0.0))),
    ("deaf@1", Scheduled(1.0, Fault(FaultKind.DEAF))),
    ("mute@1", Scheduled(1.0, Fault(FaultKind.MUTE))),
    ("echo@1+9", Scheduled(1.0, Fault(FaultKind.ECHO, for_s=9.0))),
    ("firehose@1", Scheduled(1.0, Fault(FaultKind.FIREHOSE, rate=1e6))),
    ("firehose@1,of=frame,rate=960", Scheduled(1.0, Fault(FaultKind.FIREHOSE, rate=960.0, flood=Flood.FRAME))),
    ("red:empty@5", Scheduled(5.0, Fault(FaultKind.EMPTY, "red", for_s=20.0))),
    ("brownout@10", Scheduled(10.0, Fault(FaultKind.BROWNOUT))),
]


@pytest.mark.parametrize(("text", "scheduled"), GOOD_FAULTS)
def test_scheduled_faults(text: str, scheduled: Scheduled) -> None:
    assert parse_fault(text) == scheduled


BAD_SCHEDULES = [
    ("link_drop", "[CAR:]FAULT@SECONDS"),
    ("link_drop@-1", "[CAR:]FAULT@SECONDS"),
    ("link_drop@x", "[CAR:]FAULT@SECONDS"),
    ("melt@1", "link_drop, rename, cut_write, slow, lossy, stuck, deaf, mute, echo, firehose, garbage, brownout"),
    ("brownout@1+2", "takes no amount"),
    ("garbage@1+0", "1 to 100000"),
    ("link_drop@1+9999999", "0 to 86400"),
    ("link_drop@9999999", "86400"),
    ("slow@1,factor", "FIELD=VALUE"),
    ("slow@1,factor=0", "0.001 to 1"),
    ("slow@1,factor=nan", "0.001 to 1"),
    ("slow@1,factor=fast", "0.001 to 1"),
    ("slow@1,speed=1", "use car, factor, for_s"),
    ("lossy@1,share=1.1", "0 to 1"),
    ("lossy@1,to=moon", "host, car or both"),
    ("cut_write@1,bytes=257", "0 to 256"),
    ("firehose@1,rate=1e8", "1 to 10000000"),
    ("firehose@1,of=water", "noise or frame"),
    ("rename@1,path=7", "new path of the symlink"),
    ("stuck@1+99999", "0 to 86400"),
    ("cut_write@1,bytes=7.5", "a whole number from 0 to 256"),
    ("garbage@1+1.5", "a whole number from 1 to 100000"),
    ("lossy@1,share=0.1,share=0.9", "share is given twice"),
    ("link_drop@1+2,for_s=3", "for_s is given twice"),
    ("garbage@1+20,bytes=30", "bytes is given twice"),
    ("red:slow@1,car=blue", "field 'car' is not allowed"),
    ("slow@1,fault=deaf", "field 'fault' is not allowed"),
    ("slow@1,,factor=0.1", "FIELD=VALUE"),
]


@pytest.mark.parametrize(("text", "words"), BAD_SCHEDULES)
def test_bad_scheduled_faults(text: str, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        parse_fault(text)
    assert words in str(error.value)


BAD_FAULTS: list[tuple[object, str]] = [
    ([], "one JSON object"),
    ({}, "link_drop, rename"),
    ({"fault": 3}, "link_drop, rename"),
    ({"fault": "brownout", "for_s": 2}, "'for_s'"),
    ({"fault": "link_drop", "for_s": "2"}, "0 to 86400"),
    ({"fault": "link_drop", "for_s": float("nan")}, "0 to 86400"),
    ({"fault": "link_drop", "for_s": True}, "0 to 86400"),
    ({"fault": "garbage", "bytes": 10**9}, "1 to 100000"),
    ({"fault": "garbage", "bytes": 2.5}, "a whole number from 1 to 100000"),
    ({"fault": "garbage", "to": "moon"}, "host or car"),
    ({"fault": "garbage", "car": 7}, "car 7"),
    ({"fault": "garbage", "to": "both"}, "host or car"),
    ({"fault": "slow", "factor": None}, "0.001 to 1"),
    ({"fault": "lossy", "to": ["car"]}, "host, car or both"),
    ({"fault": "rename", "path": ""}, "new path of the symlink"),
    ({"fault": "deaf", "bytes": 1}, "use car, for_s"),
]


@pytest.mark.parametrize(("fields", "words"), BAD_FAULTS)
def test_bad_faults(fields: object, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        fault_of(fields)
    assert words in str(error.value)


def test_every_fault_has_valid_example_in_help() -> None:
    examples = [word for line in EPILOG.splitlines() for word in line.split() if "@" in word]
    acts = [(parse_press if line.startswith("red:forward") else parse_fault)(line).act for line in examples]
    assert [act.kind for act in acts if isinstance(act, Fault)] == list(FaultKind)
    assert all(button in EPILOG for button in Button)


def test_presses() -> None:
    assert parse_press("red:spin_left@2.5") == Scheduled(2.5, Press(Button.SPIN_LEFT, "red"))
    assert parse_press("stop@0") == Scheduled(0.0, Press(Button.STOP))
    assert press_of({"ir": "forward", "car": "red"}) == Press(Button.FORWARD, "red")


@pytest.mark.parametrize(
    ("text", "words"),
    [("forward", "[CAR:]BUTTON@SECONDS"), ("forward@1+2", "[CAR:]BUTTON"), ("up@1", "slower"), ("stop@99999", "86400")],
)
def test_bad_presses(text: str, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        parse_press(text)
    assert words in str(error.value)


@pytest.mark.parametrize("fields", [{"ir": 7}, {"ir": ["stop"]}, {"ir": "stop", "for_s": 1}, {"ir": "stop", "car": 7}])
def test_bad_presses_on_stdin(fields: dict[str, object]) -> None:
    with pytest.raises(BadSpec, match="is not allowed"):
        press_of(fields)


CARS: list[CarSpec | ReplaySpec] = [
    parse_car("red:arduino:pty:/tmp/red"),
    parse_car("blue:raspberry_pi:tcp"),
    parse_car("green:stm32:pty:/tmp/green"),
    parse_replay("x.raw:old"),
]


@pytest.mark.parametrize(
    ("act", "names"),
    [
        (Fault(FaultKind.ECHO), ["red", "blue", "green", "old"]),
        (Fault(FaultKind.ECHO, "old"), ["old"]),
        (Fault(FaultKind.BROWNOUT), ["red", "blue", "green"]),
        (Press(Button.STOP), ["red", "blue", "green"]),
        (Fault(FaultKind.RENAME), ["red", "blue", "green", "old"]),
        (Fault(FaultKind.RENAME, "red", path="/tmp/new"), ["red"]),
    ],
)
def test_whom_it_is_for(act: Fault | Press, names: list[str]) -> None:
    assert targets(CARS, act) == names


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (Fault(FaultKind.ECHO, "nobody"), "red, blue, green, old"),
        (Fault(FaultKind.BROWNOUT, "old"), "brownout … simulated car"),
        (Press(Button.STOP, "old"), "ir … simulated car"),
        (Fault(FaultKind.RENAME, path="/tmp/new"), "needs the name of a car"),
        (Fault(FaultKind.RENAME, "blue", path="/tmp/new"), "whose link is pty:PATH"),
        (Fault(FaultKind.RENAME, "old", path="/tmp/new"), "whose link is pty:PATH"),
        (Fault(FaultKind.RENAME, "red", path="/tmp/green"), "car green"),
    ],
)
def test_whom_it_cannot_be_for(act: Fault | Press, words: str) -> None:
    with pytest.raises(BadSpec) as error:
        targets(CARS, act)
    assert has_parts(str(error.value), words)
