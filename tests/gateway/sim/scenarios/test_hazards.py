"""The hazards, on virtual time against the core, and over PTY and socket against the running simulator."""

import asyncio
import random

import pytest

from gateway.sim.model.world import World
from tests.gateway.sim.hazards import HAZARDS, Hazard
from tests.gateway.sim.strangers import RUN, STOP, WireStranger, virtual


@pytest.mark.parametrize("hazard", HAZARDS, ids=str)
async def test_on_virtual_time(hazard: Hazard) -> None:
    await hazard.play(virtual(hazard.platform, world=hazard.world(), tcp=hazard.tcp))


STALL_S = 0.03
"""Maximum stall at which a failure counts. It is half of the 60 ms between two frames, and less than any block of a
row. After a longer stall, `play` repeats the row."""
REPEATED_S = 90.0
"""Maximum time for which a row is repeated while the machine stalls."""


class Stalls:
    """The longest time for which this process did not run."""

    def __init__(self) -> None:
        self.worst = 0.0

    async def watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + 0.01
            await asyncio.sleep(0.01)
            self.worst = max(self.worst, loop.time() - due)


async def play(hazard: Hazard) -> BaseException | None:
    end = asyncio.get_running_loop().time() + REPEATED_S
    while True:
        stalls = Stalls()
        watching = asyncio.create_task(stalls.watch())
        failure = await play_once(hazard)
        watching.cancel()
        if failure is None or stalls.worst < STALL_S or asyncio.get_running_loop().time() > end:
            return failure


async def play_once(hazard: Hazard) -> BaseException | None:
    try:
        car = await WireStranger.at(hazard.platform, world=hazard.world(), tcp=hazard.tcp)
        try:
            await hazard.play(car)
        finally:
            await car.leave()
    except (AssertionError, OSError) as failure:
        return failure
    return None


@pytest.fixture(scope="module")
def outcomes() -> dict[str, BaseException | None]:
    """Run all rows at once, each on a simulator of its own, because they mostly wait. Return their errors."""

    async def everything() -> list[BaseException | None]:
        return await asyncio.gather(*(play(hazard) for hazard in HAZARDS))

    return dict(zip(map(str, HAZARDS), asyncio.run(everything()), strict=True))


@pytest.mark.xdist_group("sim-hazards-wire")
@pytest.mark.parametrize("hazard", HAZARDS, ids=str)
def test_over_the_wire(hazard: Hazard, outcomes: dict[str, BaseException | None]) -> None:
    failure = outcomes[str(hazard)]
    if failure is not None:
        raise failure


async def test_run_and_stop_60_ms_apart_lose_stop_half_the_time() -> None:
    """The car loses the stop 6 times in 10 (docs/reference/protocol.md#hazards)."""
    moments = random.Random(5)
    lost = 0
    for _ in range(400):
        car = virtual(world=World.open_field())
        await car.wait(5 + 4 * moments.random())
        await car.write(RUN)
        await car.wait(0.06)
        await car.write(STOP)
        await car.wait(3.0)
        lost += car.truth.driving
    assert 0.4 < lost / 400 < 0.7
