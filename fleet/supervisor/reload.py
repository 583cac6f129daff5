"""What a fleet file that was changed while running means: what is done, and what needs a new start. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from fleet.supervisor.spec import SIMULATED, CarProcessSpec, FleetSpec, Listed

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

    wish: FleetSpec
    """What can be had now."""
    gone: tuple[str, ...]
    begun: tuple[str, ...]
    """Cars whose gateway is started, or started anew."""
    words: tuple[str, ...]


def change(old: FleetSpec, new: FleetSpec) -> Change:
    """What becomes of `old` when `new` is wanted."""
    words = [
        f"{what} cannot be changed while running (fleet down, fleet up)"
        for name, what in _FIXED.items()
        if getattr(old, name) != getattr(new, name)
    ]
    cars: dict[str, CarProcessSpec] = {}
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
    # A car that stays as it was, against the file, keeps what is said of it there, too.
    kept = {name for name, car in cars.items() if car != new.cars.get(name)}
    listed = {name: told for name, told in new.listed.items() if name in cars and name not in kept}
    listed |= {name: told for name, told in old.listed.items() if name in kept}
    words += [
        f"{name}: {said}"
        for name in cars
        if name not in begun and (said := _told_anew(old.listed.get(name), listed.get(name)))
    ]
    wish = replace(old, cars=cars, plan=new.plan, plan_text=new.plan_text, listed=listed, doubts=new.doubts)
    return Change(wish, gone, tuple(begun), tuple(words))


def _told_anew(before: Listed | None, now: Listed | None) -> str:
    """What the coordinator has to learn of a car that was there before."""
    if before is None or now is None:
        return ""
    fields = ("platform", "capabilities", "roles")
    changed = [name for name in fields if getattr(before, name) != getattr(now, name)]
    return f"its {' and '.join(changed)} changed, for the coordinator" if changed else ""
