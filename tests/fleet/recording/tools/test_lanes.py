"""The lanes of a time line."""

from typing import Any

import pytest

from fleet.recording.tools.lanes import MAX_SPANS, NOT_HEARD, Lane, Lanes
from schemas.gen import fleet_v1_pb2 as pb

S = 1_000_000_000
MODE, MOTION, SAFETY, LINK, COMMAND = ("state/mode", "state/motion", "state/safety", "state/link", "event/command")


def mode(asked: str, verdict: str = "confirmed", inferred: str = "") -> pb.Mode:
    return pb.Mode(asked=asked, inferred=inferred or asked, verdict=verdict)


def stop(phase: str, id_: str = "1", basis: str = "") -> pb.CommandEvent:
    return pb.CommandEvent(id=id_, verb="stop", sender="mia@host-1", phase=phase, basis=basis)


ESTOP = pb.Safety(estops=[pb.Estop(by="mia@host-1")])
HOLD = pb.Safety(hold=pb.Hold(by="bob@host-2"))


@pytest.mark.parametrize(
    ("topic", "lane", "said", "spans"),
    [
        (MODE, Lane.MODE, [(0, mode("manual")), (1, mode("manual"))], [(0, 1, "manual", False)]),
        (
            MODE,
            Lane.MODE,
            [(0, mode("manual")), (2, mode("tracking")), (3, mode("tracking"))],
            [(0, 2, "manual", False), (2, 3, "tracking", False)],
        ),
        (
            MODE,
            Lane.MODE,
            [(0, mode("manual")), (9, mode("manual"))],
            [(0, 0, "manual", False), (9, 9, "manual", False)],
        ),
        (MODE, Lane.MODE, [(0, mode("manual")), (1, mode("unknown")), (2, mode("unknown"))], [(0, 1, "manual", False)]),
        (MODE, Lane.MODE, [(0, mode("manual", "contradicted", "tracking"))], [(0, 0, "tracking", True)]),
        (
            MOTION,
            Lane.DRIVER,
            [(0, pb.Motion(motion="forward", owner="mia")), (1, pb.Motion(motion="stop", owner="mia"))],
            [(0, 1, "mia", False)],
        ),
        (
            SAFETY,
            Lane.HOLD,
            [(0, HOLD), (1, ESTOP), (2, pb.Safety())],
            [(0, 1, "hold by bob", False), (1, 2, "e-stop by mia", True)],
        ),
        (
            LINK,
            Lane.LOSS,
            [(0, pb.Link(state="online")), (1, pb.Link(state="lost")), (2, pb.Link(state="online"))],
            [(1, 2, "lost", True)],
        ),
        (LINK, Lane.LOSS, [(0, pb.Link(state="quiet")), (8, pb.Link(state="online"))], [(0, 8, "not heard", True)]),
        (
            LINK,
            Lane.LOSS,
            [(0, pb.Link(state="online")), (8, pb.Link(state="lost")), (9, pb.Link(state="lost"))],
            [(0, 8, "not heard", True), (8, 9, "lost", True)],
        ),
        (
            COMMAND,
            Lane.STOP,
            [(0, stop("asked")), (1, stop("sent")), (3, stop("complete", basis="shown"))],
            [(0, 3, "stop by mia complete (shown)", False)],
        ),
        (
            COMMAND,
            Lane.STOP,
            [(0, stop("asked")), (0, stop("asked", "2")), (2, stop("failed")), (3, stop("complete", "2"))],
            [(0, 2, "stop by mia failed", True), (0, 3, "stop by mia complete", False)],
        ),
        (COMMAND, Lane.STOP, [(0, pb.CommandEvent(id="1", verb="mode", phase="sent"))], []),
    ],
)
def test_lane_spans_of_each_topic(
    topic: str, lane: Lane, said: list[tuple[int, Any]], spans: list[tuple[int, int, str, bool]]
) -> None:
    lanes = Lanes()
    for at_s, message in said:
        lanes.add("red", topic, message, at_s * S)
    found = [(each.begin_ns / S, each.end_ns / S, each.words, each.bad) for each in lanes.since(0)]
    assert found == spans
    assert {each.lane for each in lanes.since(0)} <= {lane}


def test_car_that_is_not_heard_any_more_is_lost_until_now() -> None:
    lanes = Lanes()
    for car, last_s in (("red", 4), ("blue", 9)):
        lanes.add(car, LINK, pb.Link(state="online"), 0)
        lanes.add(car, LINK, pb.Link(state="online"), 2 * S)
        lanes.add(car, LINK, pb.Link(state="online"), last_s * S)
    assert [each.as_list() for each in lanes.silences(10 * S)] == [["red", "loss", 4000, 10_000, NOT_HEARD, True]]
    lanes.add("red", LINK, pb.Link(state="online"), 11 * S)
    assert list(lanes.silences(11 * S)) == []
    assert [each.as_list() for each in lanes.since(0) if each.car == "red"] == [
        ["red", "loss", 4000, 11_000, NOT_HEARD, True]
    ]


def test_later_span_wins_at_shared_boundary() -> None:
    lanes = Lanes()
    for at_s, word in ((0, "manual"), (2, "tracking"), (3, "tracking")):
        lanes.add("red", MODE, mode(word), at_s * S)
    told = {at_s: lanes.at(at_s * S) for at_s in (0, 2, 3, 4)}
    assert {at_s: [each.words for each in found.values()] for at_s, found in told.items()} == {
        0: ["manual"],
        2: ["tracking"],
        3: ["tracking"],
        4: [],
    }


def test_oldest_spans_are_forgotten() -> None:
    lanes = Lanes()
    for at_s in range(MAX_SPANS + 10):
        lanes.add("red", MODE, mode("manual" if at_s % 2 else "tracking"), at_s * S)
        lanes.add("red", COMMAND, stop("asked", str(at_s)), at_s * S)
    assert len(lanes.spans["red", Lane.MODE]) == len(lanes.spans["red", Lane.STOP]) == MAX_SPANS


def test_cars_that_are_forgotten_leave_nothing() -> None:
    lanes = Lanes()
    for car in ("red", "blue"):
        lanes.add(car, MODE, mode("manual"), 0)
        lanes.add(car, COMMAND, stop("asked", car), 0)
        lanes.add(car, LINK, pb.Link(state="online"), 0)
    lanes.keep({"red"})
    lanes.add("blue", LINK, pb.Link(state="online"), 9 * S)
    assert {each.car for each in lanes.since(0)} == {"red"}, "nor is the time before it a loss"
