"""The fleet file: which cars there are, and what each is, may do and must not. Read whole, checked whole, resolved.

A car overrides its type, a type the defaults; lists replace, `limits` merge. What is there and answers, `fleet check`
finds out; nothing is opened here but the file.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final

from pydantic import AfterValidator, Field

from fleet.faults import Where, meant, shown
from fleet.links import ALLOWED, BadLink, Link, parse_link
from fleet.marked import BadFile, Document, Entry, read_text
from gateway.protocol.profile import AUTO, OPTIONS, Platform, parse_platform, parse_told
from gateway.protocol.values import Mode
from schemas import bus, keys

LONGEST_DRIVE_S: Final = 10.0
LOW_V, CRITICAL_V = 7.0, 6.6
EMPTY_V, FULL_V = 6.4, 8.4  # protocol.md: two Li-ion cells
PALETTE: Final = ("#e01b24", "#33d17a", "#3584e4", "#f6d32d", "#9141ac", "#ff7800", "#2ec7c0", "#986a44")
"""Colours of cars that are given none, in the order of the file."""
PATHS: Final = ("plan", "recordings", "world")
SCHEMA_NAME: Final = "fleet.schema.json"


class BatteryAction(StrEnum):
    """What a battery's level leads to, as `gateway run --battery-low` takes it."""

    WARN = "warn"
    REFUSE = "refuse"
    STOP = "stop"


@dataclass(frozen=True, slots=True)
class Limits:
    """What a car is kept within.

    longest_drive_s: the longest `duration_s` of a drive, up to 3600. speed_max: 0 to 1 of its fastest. battery_*_v:
    below this the level is low, critical; at rest.
    """

    longest_drive_s: float = LONGEST_DRIVE_S
    speed_max: float = 1.0
    battery_low_v: float = LOW_V
    battery_critical_v: float = CRITICAL_V
    on_battery_low: BatteryAction = BatteryAction.WARN
    on_battery_critical: BatteryAction = BatteryAction.REFUSE


@dataclass(frozen=True, slots=True)
class CarSpec:
    """One car, resolved: nothing is left to look up in its type or the defaults.

    link: as `gateway run --link` takes it. platform: as `--platform` does. colour: #rrggbb. capabilities: modes and
    parts by their words; with platform `auto` and none given, all that any platform has, until its gateway knows.
    roles: those it may take; None: any.
    """

    name: str
    link: str
    platform: str
    colour: str
    capabilities: frozenset[str]
    limits: Limits = Limits()
    roles: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class FleetFile:
    """A fleet file, every car resolved, every path absolute.

    endpoint: of the bus; None: FLEET_ENDPOINT, or loopback. unbound: cars without a link (`fleet bind`).
    """

    name: str
    endpoint: str | None
    cars: Mapping[str, CarSpec]
    plan: Path | None
    recordings: Path | None
    record: bool
    world: Path | None
    text: str
    path: Path
    unbound: tuple[str, ...] = ()


def _checked_name(name: str) -> str:
    return keys.check_name(name, "name")


def _checked_link(text: str) -> str:
    try:
        parse_link(text)
    except BadLink as error:
        raise ValueError(f"{shown(text)} is not allowed, {error}: {ALLOWED}") from None
    return text


def _checked_platform(text: str) -> str:
    parse_told(text)
    return text


def _checked_endpoint(text: str) -> str:
    return bus.resolve_endpoint(text) if text else _bad_endpoint()


def _bad_endpoint() -> str:
    raise ValueError("'' is not allowed: write tcp/HOST:PORT, or leave it out")


def _checked_colour(text: str) -> str:
    if len(text) != 7 or text[0] != "#" or set(text[1:].lower()) - set("0123456789abcdef"):
        raise ValueError(
            f'{shown(text)} is not allowed: a colour in quotes as "#e01b24", red, green and blue from 00 to ff'
        )
    return text.lower()


def _checked_path(text: str) -> str:
    if not text or not text.isprintable():
        raise ValueError(f"{shown(text)} is not allowed: a path, from the place of this file")
    return text


PARTS: Final = frozenset().union(*(parse_platform(f"{kind}+arm+imu").capabilities for kind in Platform))
CAPABILITIES: Final = tuple(sorted(PARTS | set(Mode)))
_Words = StrEnum("_Words", {word: word for word in CAPABILITIES})  # type: ignore[misc]  # the words are the platforms' own
_PLATFORMS: Final = f"^({'|'.join((AUTO, *Platform))})([+]({'|'.join(sorted(OPTIONS))}))*$"

_Name = Annotated[
    str, AfterValidator(_checked_name), Field(json_schema_extra={"pattern": "^[a-z0-9][a-z0-9_-]{0,31}$"})
]
_Link = Annotated[str, AfterValidator(_checked_link), Field(examples=["/dev/ttyUSB0", "tcp://192.168.1.7:8888"])]
_Platform = Annotated[str, AfterValidator(_checked_platform), Field(json_schema_extra={"pattern": _PLATFORMS})]
_Colour = Annotated[str, AfterValidator(_checked_colour), Field(json_schema_extra={"pattern": "^#[0-9a-fA-F]{6}$"})]
_Path = Annotated[str, AfterValidator(_checked_path)]
_Volts = Annotated[float, Field(ge=EMPTY_V, le=FULL_V)]


class _Limits(Entry):
    """What a car is kept within."""

    longest_drive_s: float = Field(
        default=LONGEST_DRIVE_S, gt=0, le=3600, description="longest duration of a drive, seconds"
    )
    speed_max: float = Field(default=1.0, gt=0, le=1, description="1 is the car's fastest, 0.5 half of it")
    battery_low_v: _Volts = Field(default=LOW_V, description="below this the battery is low, volts at rest")
    battery_critical_v: _Volts = Field(default=CRITICAL_V, description="below this it is critical, volts at rest")
    on_battery_low: BatteryAction = Field(default=BatteryAction.WARN, description="what a low battery leads to")
    on_battery_critical: BatteryAction = Field(default=BatteryAction.REFUSE, description="what a critical one leads to")


class _Common(Entry):
    """What defaults, types and cars may all say."""

    # Empty where nothing stands in the file; what counts is the text merged, never these.
    platform: _Platform = Field(default=AUTO, description="its program, with +arm, +imu; auto: its gateway finds out")
    colour: _Colour = Field(default_factory=str, description='in tables and pictures, in quotes: "#e01b24"')
    capabilities: list[_Words] = Field(default_factory=list, description="modes and parts to use, fewer than it has")
    limits: _Limits = Field(default_factory=_Limits, description="what it is kept within")
    roles: list[_Name] = Field(default_factory=list, description="roles of the plan that it may take; left out: any")


class _Car(_Common):
    """One car."""

    type: str = Field(default_factory=str, description="one of the types above")
    link: _Link = Field(default_factory=str, description="how it is reached; `gateway scan` shows links")


class _File(Entry):
    """A fleet of cars, for `fleet up`."""

    name: _Name = Field(default=keys.DEFAULT_FLEET, description="the first part of every key")
    endpoint: Annotated[str, AfterValidator(_checked_endpoint)] = Field(
        default_factory=str, description="the bus, tcp/HOST:PORT; left out: FLEET_ENDPOINT, or loopback"
    )
    plan: _Path = Field(default_factory=str, description="what the fleet should do, a file")
    record: bool = Field(default=True, description="whether `fleet up` records")
    recordings: _Path = Field(default_factory=str, description="the directory of recordings")
    world: _Path = Field(default_factory=str, description="the world of simulated cars, a file")
    defaults: _Common = Field(default_factory=_Common, description="for every car")
    types: dict[_Name, _Common] = Field(default_factory=dict, description="kinds of cars, which override the defaults")
    cars: dict[_Name, _Car] = Field(description="at least one car, as `red: {link: /dev/ttyUSB0}`", min_length=1)


def read_fleet(path: Path | str, *, unbound: bool = False) -> FleetFile:
    """The fleet in a file, every car resolved; raises BadFile. `unbound`: cars without a link are let through."""
    path = Path(path)
    return parse_fleet(read_text(path), path, unbound=unbound)


def parse_fleet(text: str, path: Path, *, unbound: bool = False) -> FleetFile:
    """The fleet in a text, as if it stood in this file; raises BadFile."""
    document = Document(text, str(path))
    file = document.take(_File)
    tree = _mapping(document.tree)
    for where, words in _contradictions(tree, path, unbound=unbound):
        document.complain(where, words)
    document.end()
    assert file is not None  # else the document had ended
    merged = {name: _merged(tree, car) for name, car in tree["cars"].items()}
    places = {name: _beside(path, tree.get(name)) for name in PATHS}
    return FleetFile(
        name=file.name,
        endpoint=file.endpoint or None,
        cars=MappingProxyType(
            {name: _spec(name, car, index) for index, (name, car) in enumerate(merged.items()) if "link" in car}
        ),
        record=file.record,
        text=text,
        path=path.absolute(),
        unbound=tuple(name for name, car in merged.items() if "link" not in car),
        **places,
    )


def schema() -> dict[str, Any]:
    """The JSON Schema of fleet files, for editors."""
    made = _untitled(_File.model_json_schema())
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "fleet file", **made}


def _untitled(part: Any) -> Any:
    """Without the titles that pydantic makes of names: an editor shows them instead of what is said of a field."""
    if isinstance(part, list):
        return [_untitled(each) for each in part]
    if not isinstance(part, dict):
        return part
    return {name: _untitled(each) for name, each in part.items() if name != "title" or not isinstance(each, str)}


def profile_capabilities(platform: str) -> frozenset[str]:
    """What a platform's cars have: parts and modes by their words; of `auto` what any has."""
    _, auto = parse_told(platform)
    kinds = [kind for kind in Platform if kind is not Platform.UNKNOWN] if auto else [platform.partition("+")[0]]
    options = platform.partition("+")[1] + platform.partition("+")[2]
    profiles = [parse_platform(f"{kind}{options}") for kind in kinds]
    return frozenset(str(word) for profile in profiles for word in (*profile.capabilities, *profile.modes))


def _spec(name: str, car: Mapping[str, Any], index: int) -> CarSpec:
    platform = car.get("platform", AUTO)
    limits = _Limits.model_validate(car.get("limits", {}))
    return CarSpec(
        name=name,
        link=car["link"],
        platform=platform,
        colour=car.get("colour", PALETTE[index % len(PALETTE)]).lower(),
        capabilities=frozenset(car["capabilities"]) if "capabilities" in car else profile_capabilities(platform),
        limits=Limits(**dict(limits)),
        roles=tuple(car["roles"]) if "roles" in car else None,
    )


def _merged(tree: Mapping[str, Any], car: Mapping[str, Any]) -> dict[str, Any]:
    """A car's fields: the defaults, over them its type's, over them its own."""
    merged: dict[str, Any] = {}
    limits: dict[str, Any] = {}
    kind = car.get("type")
    named = _mapping(tree.get("types")).get(kind) if isinstance(kind, str) else None
    for layer in (tree.get("defaults"), named, car):
        merged |= _mapping(layer)
        limits |= _mapping(_mapping(layer).get("limits"))
    return {**merged, "limits": limits}


def _beside(path: Path, given: str | None) -> Path | None:
    return None if given is None else (path.absolute().parent / Path(given).expanduser()).resolve()


# What no field shows by itself. These look at the text as it is, so that they tell of it along with the fields' faults.


def _contradictions(tree: Mapping[str, Any], path: Path, *, unbound: bool) -> Iterator[tuple[Where, str]]:
    cars = {name: _mapping(car) for name, car in _mapping(tree.get("cars")).items()}
    types = _mapping(tree.get("types"))
    for name, car in cars.items():
        kind = car.get("type")
        if isinstance(kind, str) and kind not in types:
            known = f"one of {', '.join(types)}" if types else "this file has no types"
            yield ("cars", name, "type"), f"{shown(kind)} is not allowed: {known}{meant(kind, types)}"
        if "link" not in car and not unbound:
            words = "is missing: how the car is reached; `gateway scan` shows links, `fleet bind` finds out which it is"
            yield ("cars", name, "link"), words
        yield from _car_contradictions(tree, name, car)
    yield from _one_port(cars)
    for field in ("plan", "world"):
        given = tree.get(field)
        if isinstance(given, str) and given and given.isprintable():
            there = _beside(path, given)
            if there is not None and not there.is_file():
                yield (field,), f"{shown(given)}: there is no such file beside this one"


def _car_contradictions(tree: Mapping[str, Any], name: str, car: Mapping[str, Any]) -> Iterator[tuple[Where, str]]:
    merged = _merged(tree, car)
    layers: list[tuple[Where, Any]] = [(("cars", name), car), (("defaults",), tree.get("defaults"))]
    if isinstance(car.get("type"), str):
        layers.insert(1, (("types", car["type"]), _mapping(tree.get("types")).get(car["type"])))
    limits = merged["limits"]
    low, critical = limits.get("battery_low_v", LOW_V), limits.get("battery_critical_v", CRITICAL_V)
    if isinstance(low, int | float) and isinstance(critical, int | float) and critical > low:
        said = (
            {"battery_low_v", "battery_critical_v"} & _mapping(_mapping(layer).get("limits")).keys()
            for _, layer in layers
        )
        at = next(where for (where, _), there in zip(layers, said, strict=True) if there)
        yield (*at, "limits"), f"battery_critical_v {critical:g} is above battery_low_v {low:g}: it is at most that"
    platform, given = merged.get("platform", AUTO), merged.get("capabilities")
    if not isinstance(platform, str) or not isinstance(given, list):
        return
    try:
        had = profile_capabilities(platform)
    except ValueError:
        return  # the platform's own fault
    if missing := [word for word in given if isinstance(word, str) and word in CAPABILITIES and word not in had]:
        at = next(where for where, layer in layers if {"platform", "capabilities"} & _mapping(layer).keys())
        words = f"{', '.join(missing)}: no {platform} car has it; allowed are {', '.join(sorted(had))}"
        yield (*at, "capabilities") if "capabilities" in _mapping(dict(layers)[at]) else at, words


def _one_port(cars: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[Where, str]]:
    links: dict[str, Link] = {}
    for name, car in cars.items():
        given = car.get("link")
        if isinstance(given, str):
            try:
                links[name] = parse_link(given)
            except BadLink:
                continue  # the link's own fault
    told: set[str] = set()
    for first, second in combinations(links, 2):
        if second not in told and links[first].may_be(links[second]):
            told.add(second)
            words = f"{shown(cars[second]['link'])} may be the port of {first}: every car has a port of its own"
            yield ("cars", second, "link"), words


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


__all__ = [
    "CAPABILITIES",
    "BadFile",
    "BatteryAction",
    "CarSpec",
    "FleetFile",
    "Limits",
    "parse_fleet",
    "profile_capabilities",
    "read_fleet",
    "schema",
]
