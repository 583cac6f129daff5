"""Compares the running spec with an edited one: which changes apply now, and which need a restart. Pure."""

from collections.abc import Mapping
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from fleet.supervisor.spec import SIMULATED, CarProcessSpec, CoordinatorCar, FleetSpec

_FIXED_PROPERTIES: Final[Mapping[str, str]] = {
    "fleet": "the fleet's name",
    "endpoint": "the endpoint",
    "world": "the world",
    "recordings": "where recordings go",
    "quota": "the quota of recordings",
    "pins": "the pins of recordings",
    "record": "whether the fleet is recorded",
    "console": "whether the page is served",
    "console_port": "the port of the page",
}
"""Properties that cannot change while the fleet is running, with their names in messages."""


class SpecChange(Struct, frozen=True):
    """The difference of two specs, as far as it can be applied while the fleet is running."""

    spec: FleetSpec
    """The spec after the reload."""
    removed: tuple[str, ...]
    restarted: tuple[str, ...]
    """Cars whose gateway is started or restarted."""
    words: tuple[str, ...]
    """One line for each car that changes, for the groups, and for the colors of cars that stay."""
    needs_restart: tuple[str, ...] = ()
    """Properties and cars that cannot change while the fleet runs, in words."""


def compare(old: FleetSpec, new: FleetSpec) -> SpecChange:
    """Return the changes from `old` to `new`."""
    words = []
    needs_restart = [what for name, what in _FIXED_PROPERTIES.items() if getattr(old, name) != getattr(new, name)]
    cars: dict[str, CarProcessSpec] = {}
    restarted = []
    for name, car in new.cars.items():
        before = old.cars.get(name)
        if car == before:
            cars[name] = car
        elif SIMULATED in (car.link, before.link if before else "") and not _is_same_simulated(before, car):
            needs_restart.append(f"{name} (a simulated car)")
            if before is not None:
                cars[name] = before
        else:
            cars[name] = car
            restarted.append(name)
            words.append(f"{name} is {'restarted' if before else 'added'}")
    removed = tuple(name for name in old.cars if name not in cars)
    words += [f"{name} is removed" for name in removed]
    # If a car cannot change, the coordinator's entry for it does not change either.
    unchanged = {name for name, car in cars.items() if car != new.cars.get(name)}
    listed = {name: entry for name, entry in new.listed.items() if name in cars and name not in unchanged}
    listed |= {name: entry for name, entry in old.listed.items() if name in unchanged}
    words += [
        f"{name}: {difference}"
        for name in cars
        if name not in restarted and (difference := _describe_difference(old.listed.get(name), listed.get(name)))
    ]
    if old.groups != new.groups:
        words.append("the groups have changed")
    if colored := [name for name in cars if name in old.cars and old.colors.get(name) != new.colors.get(name)]:
        words.append(f"in another color now: {', '.join(colored)}")
    spec = replace(
        old,
        cars=cars,
        groups=new.groups,
        colors=new.colors,
        plan=new.plan,
        plan_text=new.plan_text,
        listed=listed,
        people=new.people,
        warnings=new.warnings,
    )
    return SpecChange(spec, removed, tuple(restarted), tuple(words), tuple(needs_restart))


def _is_same_simulated(before: CarProcessSpec | None, now: CarProcessSpec) -> bool:
    """Return True if only options of the gateway differ, so that the simulator can keep running."""
    return before is not None and replace(before, arguments=now.arguments) == now


def _describe_difference(before: CoordinatorCar | None, now: CoordinatorCar | None) -> str:
    """Describe changes of a car that concern the coordinator. Return an empty string if there are none."""
    if before is None or now is None:
        return ""
    fields = ("platform", "without", "roles")
    changed = [name for name in fields if getattr(before, name) != getattr(now, name)]
    return f"the coordinator takes its new {' and '.join(changed)}" if changed else ""
