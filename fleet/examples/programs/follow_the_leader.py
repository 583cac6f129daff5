"""Let a car make the same motions as another car, until Ctrl-C.

`python -m fleet.examples.programs.follow_the_leader red blue`
"""

import asyncio
import sys
from contextlib import suppress

from fleet.aio import Fleet


async def main(leader: str, follower: str) -> None:
    """Repeat a motion of at most 1.5 s every second. If this program is killed, the car stops."""
    async with Fleet() as fleet, fleet.car(follower).lease() as car:
        motion = "stop"
        async for reading in fleet.watch(f"{leader}/state/motion"):  # published at each change, and once a second
            before, motion = motion, reading["motion"].replace("unknown", "stop")
            if motion != before:
                print(f"{follower}: {motion}", flush=True)
            if "stop" not in (before, motion) or motion != before:
                await car.drive(motion, 1.5, wait=False)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):  # the end of the lease has stopped the car
        asyncio.run(main(*sys.argv[1:]))
