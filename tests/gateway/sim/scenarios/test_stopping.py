"""The stops of docs/reference/protocol.md#stops, written independently of the gateway's code.

Stops at random moments in every load turn the motors off in time and for good. The gateway's own sequences are tested
with gateway.control. Here the simulated car must follow the table.
"""

import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import pytest

from gateway.sim.model.objects import Lamp
from gateway.sim.model.world import World
from tests.gateway.sim.strangers import FAN, MODE00, RUN, STOP, VirtualStranger, opening, opening_s, virtual

WIRE = 0.02
REPORT = 0.04
NO_ECHO = 1.0
AVOIDANCE = 4.3
THEORY = 7.3
"""Maximum time of a recovery outside avoidance, in theory."""

SOFT = ((0.0, STOP), (1.1, STOP))
FULL = ((0.0, MODE00), (1.1, STOP))
RECOVERY = ((0.0, b"#"), (0.05, MODE00), (3.7, MODE00), (4.8, STOP))
UNKNOWN = ((0.0, STOP), (0.06, MODE00), (1.16, STOP), (3.7, MODE00), (4.8, STOP))
PI = ((0.0, STOP), (0.06, STOP), (1.16, STOP))
RECIPES = {"soft": SOFT, "full": FULL, "recovery": RECOVERY, "unknown": UNKNOWN, "pi": PI}

WHISTLE_RUN = b"$1,0,1,0,0,0,0,0,0#"
PTZ = b"$4WD,PTZ120#"
NAMED = (b"$4WD,ServoJ190,J290,J390,J490,J590,J690#", b"$4WD,CLR255,CLG0,CLB16#", PTZ, b"$4WD,MODE21#")

Load = Callable[[VirtualStranger, random.Random], Awaitable[None]]


async def driving(car: VirtualStranger, moments: random.Random) -> None:
    """Drive, and wait until the car must have read the frame."""
    await car.wait(1.0 + moments.random())
    await car.write(RUN)
    await car.wait(1.2 + 2.5 * moments.random())


def within(frame: bytes, block: float) -> Load:
    """Return a load that ends at a random moment of a block.

    The block runs for sure, because its frame has left the buffer.
    """

    async def load(car: VirtualStranger, moments: random.Random) -> None:
        await driving(car, moments)
        await car.write(frame)
        await car.until(lambda truth: truth.blocked)
        await car.wait(0.99 * block * moments.random())

    return load


def in_mode(mode: int) -> Load:
    async def load(car: VirtualStranger, moments: random.Random) -> None:
        await driving(car, moments)
        await car.write(opening(mode))
        await car.wait(opening_s(mode) + 0.05 + 8 * moments.random())

    return load


def then_half(before: Load, *frames: bytes) -> Load:
    """Return a load that ends with a half frame, as after the loss of a link."""

    async def load(car: VirtualStranger, moments: random.Random) -> None:
        await before(car, moments)
        frame = frames[int(len(frames) * moments.random())]
        await car.write(frame[: 1 + int((len(frame) - 1) * moments.random())])
        await car.wait(0.5 * moments.random())

    return load


@dataclass(frozen=True)
class Case:
    recipe: str
    name: str
    load: Load
    bound: float
    worst_at_least: float = 0.0
    """Minimum of the longest time, so that the simulated car is no easier than the measured one."""
    world: Callable[[], World] = World.room
    platform: str = "arduino"
    tcp: bool = False

    def __str__(self) -> str:
        where = "-no-echo" if self.world == World.open_field else ""
        return f"{self.recipe}-{self.name}{where}{'-tcp' if self.tcp else ''}"


def lit_room() -> World:
    """Return a world with a lamp that is visible everywhere, so that light seeking drives."""
    room = World.room()
    return World(room.walls, room.line, [Lamp(9.0, 0.0, reach_m=50.0, overhead=True)])


def before_a_wall() -> World:
    """Return a world with a wall that a car must follow in mode 6 after a run of a second."""
    return World([(0.4, -9.0, 0.4, 9.0)])


BLOCKS = [
    ("whistle", within(WHISTLE_RUN, 0.30), 0.30, 0.2),
    ("ptz", within(PTZ, 0.65), 0.65, 0.55),
    *((f"opening-{x}", within(opening(x), opening_s(x)), opening_s(x), 2.2) for x in range(1, 7)),
    ("infrared-remote", in_mode(1), 0.0, 0.0),
    ("tracking", in_mode(2), 0.1, 0.0),
    ("colour-led", in_mode(4), 0.75, 0.6),
]
MOVING = [
    ("light-seeking", in_mode(5), lit_room),
    ("following", in_mode(6), before_a_wall),
]
HALVES = [
    ("half-frame", then_half(driving, RUN), THEORY, 0.0),
    ("half-frame-blocked", then_half(within(PTZ, 0.65), RUN), THEORY, 2.0),
    *((f"half-frame-opening-{x}", then_half(within(opening(x), opening_s(x)), RUN), THEORY, 3.5) for x in (1, 4, 6)),
    ("half-named-frame", then_half(driving, *NAMED), THEORY, 3.0),
]
CASES = [
    Case("soft", "driving", driving, WIRE + REPORT),
    Case("soft", "driving", driving, WIRE + NO_ECHO, 0.9, world=World.open_field),
    Case("full", "driving", driving, WIRE + REPORT),
    Case("full", "driving", driving, WIRE + NO_ECHO, 0.9, world=World.open_field),
    *(Case("full", name, load, WIRE + block, worst) for name, load, block, worst in BLOCKS),
    *(Case("full", name, load, WIRE + 0.1, 0.03, world) for name, load, world in MOVING),
    Case("full", "avoidance", in_mode(3), WIRE + AVOIDANCE, 0.8),
    Case("recovery", "driving", driving, 0.05 + WIRE + REPORT),
    Case("recovery", "driving", driving, THEORY, world=World.open_field),
    *(Case("recovery", name, load, THEORY) for name, load, _, _ in BLOCKS),
    *(Case("recovery", name, load, THEORY, 0.03, world) for name, load, world in MOVING),
    *(Case("recovery", name, load, bound, worst) for name, load, bound, worst in HALVES),
    Case("recovery", "half-frame", then_half(driving, RUN), THEORY, 2.0, world=World.open_field),
    Case("unknown", "driving", driving, WIRE + REPORT),
    Case("unknown", "driving", driving, THEORY, world=World.open_field),
    *(Case("unknown", name, load, THEORY) for name, load, _, _ in BLOCKS),
    *(Case("unknown", name, load, THEORY, 0.03, world) for name, load, world in MOVING),
    Case("unknown", "half-frame", then_half(driving, RUN), THEORY),
]
for _tcp in (False, True):
    CASES += [
        Case("pi", "driving", driving, WIRE + REPORT, platform="raspberry_pi", tcp=_tcp),
        Case("pi", "driving", driving, WIRE + NO_ECHO, world=World.open_field, platform="raspberry_pi", tcp=_tcp),
        Case("pi", "fan", within(FAN, 1.0), WIRE + 1.0, platform="raspberry_pi", tcp=_tcp),
        Case("pi", "ptz", within(PTZ, 0.65), WIRE + 0.65, platform="raspberry_pi", tcp=_tcp),
        Case("pi", "half-frame", then_half(driving, RUN), 0.06 + WIRE + REPORT, platform="raspberry_pi", tcp=_tcp),
    ]


async def stop(car: VirtualStranger, recipe: tuple[tuple[float, bytes], ...]) -> float:
    """Stop the car. Return the seconds from the first byte until the motors are off for good."""
    begun = car.now
    for at, frame in recipe:
        await car.wait(begun + at - car.now)
        await car.write(frame)
    await car.wait(12.0)
    off_at, left, right = car.car.motor_log[-1]
    assert (left, right) == (0, 0), f"drives on: {car.truth}"
    return off_at - begun


async def worst_stop(case: Case, count: int) -> float:
    """Begin stops at random moments. Return the longest time until the motors were off for good, s."""
    moments = random.Random(str(case))
    worst = 0.0
    for seed in range(count):
        car = virtual(case.platform, world=case.world(), tcp=case.tcp, seed=seed)
        await case.load(car, moments)
        worst = max(worst, await stop(car, RECIPES[case.recipe]))
    return worst


@pytest.mark.parametrize("case", CASES, ids=str)
async def test_stop_begun_at_a_random_moment(case: Case) -> None:
    assert await worst_stop(case, 40) <= case.bound


@pytest.mark.soak
@pytest.mark.parametrize("case", CASES, ids=str)
async def test_stop_begun_at_many_random_moments(case: Case) -> None:
    worst = await worst_stop(case, 400)
    print(f"{case}: {worst:.2f} s")
    assert case.worst_at_least <= worst <= case.bound


async def test_stop_and_mode00_every_1_1_s_keep_opening_car_driving() -> None:
    """More frames are not better (docs/reference/protocol.md#stops).

    All frames become one string, in which each stop hides the mode digits.
    """
    moments = random.Random(1)
    for _ in range(100):
        car = virtual()
        await within(opening(4), opening_s(4))(car, moments)
        for _ in range(20):
            await car.write(STOP)
            await car.wait(0.06)
            await car.write(MODE00)
            await car.wait(1.04)
        if car.truth.driving:
            return
    pytest.fail("each of the cars has stopped")
