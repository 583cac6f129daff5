"""Distinguishes a hub that has ended from a fleet that does not run.

Gateways run on without a hub, and their cars may go on moving.
"""

from typing import Final

from schemas.bus import BusError, NoFleet
from schemas.running_cars import running_cars

_MAX_CARS_NAMED: Final = 3


class LostHub(BusError):
    """Nothing listens at the endpoint, but gateways of this user run on this computer."""


def describe_running(endpoint: str) -> str:
    """Return a text that names the gateways of this bus that run on this computer. Empty if none does."""
    cars = running_cars(endpoint)
    more = f" and {len(cars) - _MAX_CARS_NAMED} more" if len(cars) > _MAX_CARS_NAMED else ""
    return f"gateways run here ({', '.join(cars[:_MAX_CARS_NAMED])}{more}): cars may move" if cars else ""


def explain_no_fleet(error: NoFleet) -> BusError:
    """Return the error itself, or a LostHub if gateways run without a hub."""
    running = describe_running(error.endpoint)
    if not running:
        return error
    return LostHub(
        f"The hub at {error.endpoint} does not answer, but {running}. The hub is being started again: repeat this in "
        "a few seconds. Otherwise go to the cars, and restart `fleet up`."
    )
