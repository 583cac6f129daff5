"""Let the car with the most room ahead avoid obstacles, while the other cars rest.

Three rounds of 5 s: `python -m fleet.examples.programs.custom_policy`.
"""

import time

from fleet import Fleet


def main() -> None:
    """Run as a coordinator. A car that a person has stopped or drives rejects the command: then try the next car."""
    with Fleet(kind="coordinator") as fleet:
        for _ in range(3):
            room = {reading.car: reading["range_m"] or 0.0 for reading in fleet.get("*/sensor/range")}
            for car in sorted(fleet.cars(), key=lambda car: room.get(car, 0.0), reverse=True):
                outcome = fleet.car(car).mode("obstacle_avoidance")
                print(outcome, flush=True)
                if outcome.ok:
                    time.sleep(5)
                    fleet.car(car).mode("manual")  # ends the mode, and stops the car
                    break
            else:
                time.sleep(5)  # no car carried it out


if __name__ == "__main__":
    main()
