"""Parses commands that change lamps and things of the running world, and reports their state. Pure."""

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

from gateway.sim.car_spec import BadSpec
from gateway.sim.faults import number
from gateway.sim.model.objects import FAR_M, FASTEST_M_S, Lamp, MovingObject
from gateway.sim.model.world import World

Change = Callable[[World, float], None]
"""Changes a world. The second argument is the time of the change."""
WorldState = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""The fields of each lamp and thing by its name, under `lamps` and `things`."""

_Kind = TypeVar("_Kind", Lamp, MovingObject)
_PLACE: Final = {"x_m": (-FAR_M, FAR_M), "y_m": (-FAR_M, FAR_M)}
_LAMP: Final = {**_PLACE, "brightness": (0.0, 100.0), "reach_m": (0.01, FAR_M)}
_THING: Final = {**_PLACE, "speed_m_s": (0.0, FASTEST_M_S)}


def change_of(fields: Mapping[str, object], world: World) -> Change:
    """Return the change in a JSON object from the control channel. Raises BadSpec if the object is wrong."""
    if "lamp" in fields:
        return _lamp_change(fields, _named("lamp", fields["lamp"], world.lamps))
    return _thing_change(fields, _named("thing", fields["thing"], world.things))


def _lamp_change(fields: Mapping[str, object], lamp: Lamp) -> Change:
    given: dict[str, float | bool] = dict(_numbers("lamp", fields, _LAMP, ("on",)))
    if "on" in fields:
        on = fields["on"]
        if not isinstance(on, bool):
            raise BadSpec(f"on {on!r} is not allowed: use true or false")
        given["on"] = on
    return lambda world, _: world.change_lamp(lamp.name, **given)


def _thing_change(fields: Mapping[str, object], thing: MovingObject) -> Change:
    given = _numbers("thing", fields, _THING, ())
    speed = given.pop("speed_m_s", None)
    if speed is not None and (not thing.path or given):
        why = "with x_m or y_m it leaves its path" if thing.path else f"{thing.name} has no path"
        raise BadSpec(f"speed_m_s {speed:g} is not allowed: {why}")

    def change(world: World, now: float) -> None:
        if speed is not None:
            world.speed_thing(thing.name, speed, now)
        else:
            world.put_thing(thing.name, given.get("x_m"), given.get("y_m"), now)

    return change


def _named(kind: str, name: object, those: tuple[_Kind, ...]) -> _Kind:
    found = next((each for each in those if each.name == name), None)
    if found is None:
        names = ", ".join(each.name for each in those)
        raise BadSpec(f"{kind} {name!r} is not in this world: " + (f"use {names}" if names else "it has none"))
    return found


def _numbers(
    kind: str, fields: Mapping[str, object], ranges: Mapping[str, tuple[float, float]], more: tuple[str, ...]
) -> dict[str, float]:
    allowed = ", ".join((*more, *ranges))
    for word in fields.keys() - ranges.keys() - {kind, *more}:
        raise BadSpec(f"field {word!r} is not allowed in {kind}: use {allowed}")
    if len(fields) == 1:
        raise BadSpec(f"nothing to change in {kind} {fields[kind]!r}: give {allowed}")
    return {word: number(word, fields[word], *ranges[word]) for word in ranges if word in fields}


def as_it_is(world: World, now: float) -> WorldState:
    """Return the state of lamps and things for the control channel, without those on a car that is not there."""
    lamps: dict[str, dict[str, Any]] = {}
    things: dict[str, dict[str, Any]] = {}
    for lamp in world.lamps:
        at = world.shines(lamp, now)
        if at is not None:
            lamps[lamp.name] = {
                "x_m": at[0],
                "y_m": at[1],
                "on": lamp.on,
                "brightness": lamp.brightness,
                "reach_m": lamp.reach_m,
                "carried_by": lamp.carried_by,
            }
    for thing in world.things:
        pose = world.where(thing, now)
        if pose is not None:
            size = (
                {"radius_m": thing.radius_m} if thing.radius_m else {"width_m": thing.width_m, "depth_m": thing.depth_m}
            )
            speed = thing.speed_m_s if thing.going else 0.0
            things[thing.name] = {**pose._asdict(), **size, "speed_m_s": speed, "carried_by": thing.carried_by}
    return {"lamps": lamps, "things": things}
