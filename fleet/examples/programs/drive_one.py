"""Drive one car in a square.

`python -m fleet.examples.programs.drive_one red`
"""

import sys

from fleet import Fleet, NotCarriedOut
from schemas.bus import BusError


def main(name: str) -> None:
    """Reserve the car while the block runs. At its end, the car is stopped and released."""
    with Fleet() as fleet, fleet.car(name).lease() as car:
        for _ in range(4):
            car.drive("forward", 0.5)
            car.drive("spin_left", 0.3)
        car.light("green")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (NotCarriedOut, BusError) as error:  # the text names the car, or the missing fleet, and the reason
        sys.exit(str(error))
