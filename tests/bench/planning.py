"""Time of one decision of the coordinator for 50 cars and 20 rules. The floor only reads the readings of each rule."""

from time import perf_counter

from msgspec.structs import replace

from fleet.policy.decide import step
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot
from fleet.policy.state import PolicyState
from tests.bench.measured import Measured, Scale, in_turns, percentile
from tests.fleet.policy.cars import observed

CARS = tuple(f"car{number:02}" for number in range(50))
PLAN = parse(
    "roles:\n"
    + "\n".join(
        f"  role{number}: {{mode: {mode}, needs: battery.voltage_v > 7.0, count: 5, priority: {number % 3}}}"
        for number, mode in enumerate(("tracking", "following", "light_seeking", "obstacle_avoidance", "color_led") * 2)
    )
    + "\nrules:\n"
    + "\n".join(
        f"  - when: {{any_car: light.left and range.range_m < 0.{number + 10}, for_s: 1}}\n"
        "    then: {who: this_car, mode: manual}"
        for number in range(20)
    )
)
HERE = CarSnapshot(present=True, mode="manual", verdict="confirmed", link="online", motors="off", platform="arduino")
STEPS = 100


def _pictures(count: int) -> list[FleetSnapshot]:
    """Return snapshots with new readings of every car. In every second snapshot, one car is on hold."""
    found = []
    for number in range(count):
        readings = {
            car: {
                "sensor/battery": observed("sensor/battery", number * 0.1, voltage_v=7.4),
                "sensor/light": observed("sensor/light", number * 0.1, left=number % 3 == 0, right=False),
                "sensor/range": observed("sensor/range", number * 0.1, range_m=0.2),
            }
            for car in CARS
        }
        away = replace(HERE, held_by="ann") if number % 2 else HERE
        found.append(FleetSnapshot({**dict.fromkeys(CARS, HERE), CARS[number % 50]: away}, readings))
    return found


def _ours(pictures: list[FleetSnapshot]) -> float:
    memory = PolicyState()
    took = []
    for number, picture in enumerate(pictures):
        began = perf_counter()
        memory = step(PLAN, picture, memory, number * 0.1).memory
        took.append(perf_counter() - began)
    return percentile(took, 0.95) * 1e3


def _floor(pictures: list[FleetSnapshot]) -> float:
    seen = pictures[0].readings
    took = []
    for _ in pictures:
        began = perf_counter()
        for _ in PLAN.rules:
            for car in CARS:
                reading = seen[car]
                assert reading["sensor/light"].message.left in (True, False)
                assert reading["sensor/range"].message.range_m == 0.2
        took.append(perf_counter() - began)
    return percentile(took, 0.95) * 1e3


def run(scale: Scale) -> list[Measured]:
    pictures = _pictures(scale.count(STEPS, 5))
    ours, floor = in_turns(scale, lambda: _ours(pictures), lambda: _floor(pictures))
    return [
        Measured(f"one decision, 50 cars, 20 rules: p95 of {len(pictures)}", tuple(ours), tuple(floor), "ms", 0.0, 10.0)
    ]
