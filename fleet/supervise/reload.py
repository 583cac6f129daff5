"""What a fleet file that was changed while running means: what is done, and what needs a new start. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from fleet.supervise.wanted import SIMULATED, Wanted, WantedCar

_FIXED: Final[Mapping[str, str]] = {
    "fleet": "the fleet's name",
    "endpoint": "the endpoint",
    "world": "the world",
    "recordings": "where recordings go",
    "record": "whether it records",
}
"""What the processes that run are bound to."""


@dataclass(frozen=True, slots=True)
class Change:
    """From one wish to the next; `words` tell of it, one line each."""

    wish: Wanted
    """What can be had now."""
    gone: tuple[str, ...]
    begun: tuple[str, ...]
    """Cars whose gateway is started, or started anew."""
    words: tuple[str, ...]


def change(old: Wanted, new: Wanted) -> Change:
    """What becomes of `old` when `new` is wanted, without the plan's text."""
    words = [
        f"{what} cannot be changed while running (fleet down, fleet up)"
        for name, what in _FIXED.items()
        if getattr(old, name) != getattr(new, name)
    ]
    cars: dict[str, WantedCar] = {}
    begun = []
    for name, car in new.cars.items():
        before = old.cars.get(name)
        if car == before:
            cars[name] = car
        elif SIMULATED in (car.link, before.link if before else ""):
            words.append(f"{name}, a simulated car, cannot be changed while running (fleet down, fleet up)")
            if before is not None:
                cars[name] = before
        else:
            cars[name] = car
            begun.append(name)
            words.append(f"{name} is {'begun anew' if before else 'added'}")
    gone = tuple(name for name in old.cars if name not in cars)
    words += [f"{name} is taken out" for name in gone]
    return Change(replace(old, cars=cars, plan=new.plan), gone, tuple(begun), tuple(words))
