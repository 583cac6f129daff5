"""What is pinned while messages come: conditions, stops, what is not shown, and what came late."""

from typing import Any

from fleet.fleetfile.fleet_file import PinRule
from fleet.policy.car_condition import parse_condition
from fleet.recording.pins import MAX_PINS, Pin, PinList, minute_of, pins_of
from fleet.recording.writing.pin_watch import PinWatch
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from schemas.words import PinCause

S = 1_000_000_000
START_NS = 1_790_000_000 * S


def watch(*conditions: str) -> PinWatch:
    return PinWatch([PinRule(parse_condition(each), 10, 20) for each in conditions])


def put(
    of: PinWatch, car: str, topic: str, message: Any, at_s: float, came_s: float | None = None
) -> list[tuple[Any, ...]]:
    at_ns = START_NS + round(at_s * S)
    message.stamp.FromNanoseconds(at_ns)
    came_ns = at_ns if came_s is None else START_NS + round(came_s * S)
    encoding = messages.encoding_of(TOPICS[topic].message)
    found = of.add(f"fleet/{car}/{topic}", encoding, message.SerializeToString(), at_ns, came_ns)
    return [((pin.begin_ns - START_NS) / S, (pin.end_ns - START_NS) / S, pin.cause, pin.cars) for pin in found]


def test_condition_pins_before_first_and_after_last_reading() -> None:
    of = watch("range_m < 0.3")
    assert put(of, "red", "sensor/range", pb.Range(range_m=1.0), 0) == []
    assert put(of, "red", "sensor/range", pb.Range(range_m=0.2), 1) == [(-9, 21, PinCause.CONDITION, ("red",))]
    assert put(of, "red", "sensor/range", pb.Range(range_m=0.2), 2) == [(-9, 22, PinCause.CONDITION, ("red",))]
    assert put(of, "blue", "sensor/range", pb.Range(range_m=1.0), 2) == []
    assert put(of, "red", "sensor/range", pb.Range(range_m=0.2), 9) == [(-1, 29, PinCause.CONDITION, ("red",))], "a gap"
    assert put(of, "red", "sensor/range", pb.Range(range_m=0.2), 8) == [], "out of order"
    pinned = put(of, "red", "sensor/range", pb.Range(range_m=0.2), -3600, came_s=10)
    assert pinned == [(0, 30, PinCause.CONDITION, ("red",))], "its clock stepped back; the recorder's counts"


def test_function_of_a_field_pins() -> None:
    of = watch("rate(range_m) < -1")
    assert put(of, "red", "sensor/range", pb.Range(range_m=2.0), 0) == []
    assert len(put(of, "red", "sensor/range", pb.Range(range_m=0.5), 1)) == 1


def event(verb: str, phase: str = "asked", command: str = "1", reason: str = "") -> pb.CommandEvent:
    return pb.CommandEvent(verb=verb, phase=phase, id=command, reason=reason, sender="mia@host-1")


def test_stops_pin_their_minute() -> None:
    of = watch()
    for car in ("red", "blue"):
        assert put(of, car, "event/command", event("drive", command="0"), 0) == []
    assert put(of, "red", "event/command", event("estop", command="2"), 1) == [(-29, 31, PinCause.ESTOP, ("red",))]
    assert put(of, "red", "event/command", event("stop", command="3"), 1) == [], "of one car of two"
    both = [(-29, 31, PinCause.STOP_ALL, ("blue", "red"))]
    assert put(of, "blue", "event/command", event("stop", command="3"), 1) == both
    failed = event("stop", "failed", "4", "not_shown")
    assert put(of, "red", "event/command", failed, 1) == [(-29, 31, PinCause.NOT_SHOWN, ("red",))]
    assert of.add("fleet/red/event/command", "text/plain", b"estop", 0, 0) == []
    assert of.add("fleet/red/event/command", messages.encoding_of("fleet.v1.CommandEvent"), b"\xff", 0, 0) == []
    assert put(watch(), "red", "event/command", event("stop"), 1) == [(-29, 31, PinCause.STOP_ALL, ("red",))], (
        "the only"
    )


def test_late_message_pins_from_its_stamp_to_its_arrival() -> None:
    of = watch("range_m < 0.3")
    message = pb.Range(range_m=0.2)
    message.stamp.FromNanoseconds(START_NS)
    encoding = messages.encoding_of("fleet.v1.Range")
    came_ns = START_NS + 40 * S
    late = (START_NS, "fleet/red/sensor/range", encoding, message.SerializeToString())
    (pin,) = of.add_late([late], came_ns)
    assert (pin.begin_ns, pin.end_ns) == (START_NS - 10 * S, came_ns)


def test_touching_pins_merge_and_number_is_limited() -> None:
    pins = PinList()
    assert pins.add(minute_of(START_NS, PinCause.ESTOP, "estop by mia", ["red"]))
    assert pins.add(minute_of(START_NS + 60 * S, PinCause.ESTOP, "estop by lee", ["blue"]))
    assert not pins.add(minute_of(START_NS + 60 * S, PinCause.ESTOP, "estop by lee", ["blue"]))
    (one,) = pins.pins
    assert (one.end_ns - one.begin_ns, one.words, one.cars) == (120 * S, "estop by mia", ("red", "blue"))
    for number in range(2 * MAX_PINS):
        pins.add(minute_of(START_NS + number * 100 * S, PinCause.STOP_ALL, "stop"))
    assert len(pins.pins) == MAX_PINS
    assert max(pin.end_ns for pin in pins.pins) == START_NS + ((2 * MAX_PINS - 1) * 100 + 30) * S


def test_pin_json_round_trip_and_invalid_pins_are_left_out() -> None:
    pin = Pin(START_NS, START_NS + S, PinCause.CONDITION, "range_m < 0.1", ("red",))
    assert Pin.from_dict(pin.to_dict()) == pin
    assert pins_of([pin.to_dict(), {}, {"from": 1, "to": 2, "cause": 3}], [{"time": "nonsense"}]) == [pin]
    (mark,) = pins_of([], [{"time": pin.to_dict()["from"], "text": "the cat"}])
    assert (mark.begin_ns, mark.end_ns, mark.cause) == (START_NS - 30 * S, START_NS + 30 * S, PinCause.MARK)
