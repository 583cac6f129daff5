"""Reads a fleet file: the cars, their platforms, capabilities and limits. All faults are reported at once.

The fields of a car override those of its type, which override the defaults. A list replaces the list of the type or the
defaults. `limits` are merged field by field. This module opens no link: link_check.py checks whether the cars can be
reached.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from msgspec import Struct, field

from fleet.conditions import BadExpression, Expression
from fleet.fleet_links import LINK_SIM, FleetLink, parse_fleet_link, shared_ports
from fleet.fleetfile.fleet_model import (
    CAPABILITIES,
    ConsoleEntry,
    FileEntry,
    LimitsEntry,
    PersonEntry,
    PersonRank,
    PinEntry,
    RecordEntry,
)
from fleet.policy.car_condition import parse_condition
from fleet.quota import Quota
from gateway import drivers
from schemas.battery_levels import CRITICAL_V, LOW_V
from schemas.colors import Rgb, car_color, hex_color, parse_color
from schemas.duration import parse_duration
from schemas.limits import DEFAULT_MAX_DRIVE_S
from schemas.links import BadLink
from schemas.platform_name import AUTO, normalize_name
from schemas.rights import NO_PEOPLE, People, PersonRole
from schemas.words import BatteryAction, Mode, Platform
from schemas.yaml_document.document import BadFile, Document, read_text
from schemas.yaml_document.fault_words import Where, quote_value, suggest

PATHS: Final = ("plan", "world")
_MODES_TO_OPEN: Final = frozenset(Mode) - {Mode.MANUAL}
_MODES_THAT_DRIVE: Final = _MODES_TO_OPEN - {Mode.COLOR_LED}


class Limits(Struct, frozen=True):
    """The limits of a car.

    longest_drive_s: maximum `duration_s` of a drive, up to 3600. speed_max: 0 to 1 of its top speed. battery_*_v:
    voltage at rest below which the level is low or critical.
    """

    longest_drive_s: float = DEFAULT_MAX_DRIVE_S
    speed_max: float = 1.0
    battery_low_v: float = LOW_V
    battery_critical_v: float = CRITICAL_V
    on_battery_low: BatteryAction = BatteryAction.WARN
    on_battery_critical: BatteryAction = BatteryAction.REFUSE


class FleetCar(Struct, frozen=True):
    """One car with its type and the defaults resolved.

    link, platform: values for `gateway run --link` and `--platform`. color: #rrggbb. capabilities: words for modes and
    parts. A car of platform `auto` has the capabilities of all platforms until its gateway detects the platform. roles:
    the roles that the car may have. None means any.
    """

    name: str
    link: str
    platform: str
    color: str
    capabilities: frozenset[str]
    limits: Limits = Limits()
    roles: tuple[str, ...] | None = None


class FleetPerson(Struct, frozen=True):
    """One person with their rank and the cars that they may drive. If `cars` is None, they may drive all."""

    rank: PersonRank = PersonRank.PERSON
    drives: tuple[str, ...] | None = None

    def may_drive(self, car: str) -> bool:
        """Return True if this person may drive the car."""
        return self.drives is None or car in self.drives


class PinRule(Struct, frozen=True):
    """A condition. Recordings are pinned from `before_s` before it becomes true to `after_s` after it ends."""

    condition: Expression
    before_s: float
    after_s: float


class FleetFile(Struct, frozen=True):
    """A fleet file with resolved cars and absolute paths.

    endpoint: the bus, or None for the default of `bus.resolve_endpoint`. quota: maximum size of the recordings.
    console_port: the port of the web page, 0 for the default. groups: cars by group. people: the only people who may
    drive, or None if everyone may. unlinked: cars without a link, if they are allowed. pins: the times that are pinned
    in recordings.
    """

    name: str
    endpoint: str | None
    cars: Mapping[str, FleetCar]
    plan: Path | None
    recordings: Path | None
    quota: Quota
    record: bool
    console: bool
    console_port: int
    world: Path | None
    text: str
    path: Path
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    people: Mapping[str, FleetPerson] | None = None
    unlinked: Mapping[str, FleetCar] = field(default_factory=dict)
    pins: tuple[PinRule, ...] = ()

    @property
    def unbound(self) -> tuple[str, ...]:
        """The names of the cars without a link (`fleet bind`)."""
        return tuple(self.unlinked)


def read_fleet(path: Path | str, *, unbound: bool = False, moved: bool = False) -> FleetFile:
    """Read a fleet file. Raises BadFile if it has mistakes. `unbound` allows cars without a link.

    With `moved`, the file is the copy in a session, so its plan and its world need not exist.
    """
    path = Path(path)
    return parse_fleet(read_text(path), path, unbound=unbound, moved=moved)


def read_colors(path: Path) -> Mapping[str, Rgb]:
    """Return the colors of the cars in a fleet file. Empty if it cannot be read."""
    try:
        file = read_fleet(path, unbound=True, moved=True)
    except BadFile:
        return {}
    return {name: parse_color(car.color) for name, car in {**file.cars, **file.unlinked}.items()}


def people_table(people: Mapping[str, FleetPerson] | None) -> People:
    """Return the people in a fleet file as `schemas.rights` knows them. Gateways check who may drive which car."""
    if people is None:
        return NO_PEOPLE
    leads = {name for name, person in people.items() if person.rank is PersonRank.LEAD}
    return People({name: PersonRole.LEAD if name in leads else PersonRole.DRIVER for name in people})


def read_people(path: Path) -> Mapping[str, FleetPerson] | None:
    """Return the people in a fleet file by name. None if it lists none, or cannot be read."""
    try:
        return read_fleet(path, unbound=True, moved=True).people
    except BadFile:
        return None


def parse_fleet(text: str, path: Path, *, unbound: bool = False, moved: bool = False) -> FleetFile:
    """Parse the text of a fleet file at this path. Raises BadFile if it has mistakes."""
    document = Document(text, str(path))
    file = document.validate(FileEntry)
    tree = _as_mapping(document.tree)
    for where, words in _find_contradictions(tree, path, unbound=unbound, moved=moved):
        document.report(where, words)
    document.raise_faults()
    assert file is not None  # otherwise raise_faults has raised
    merged = {name: _merge_layers(tree, car) for name, car in tree["cars"].items()}
    places = {name: _resolve_path(path, tree.get(name)) for name in PATHS}
    record = file.record if isinstance(file.record, RecordEntry) else None
    cars = {name: _resolve_car(name, car, index) for index, (name, car) in enumerate(merged.items())}
    return FleetFile(
        name=file.name,
        endpoint=file.endpoint or None,
        cars=MappingProxyType({name: car for name, car in cars.items() if car.link}),
        record=file.record is not False,
        console=file.console is not False,
        console_port=file.console.port if isinstance(file.console, ConsoleEntry) else 0,
        recordings=_resolve_path(path, record.to or None if record else None),
        quota=record.limits if record else Quota(),
        groups=MappingProxyType({name: tuple(cars) for name, cars in file.groups.items()}),
        people=_resolve_people(file) if "people" in tree else None,
        pins=tuple(map(_resolve_pin, file.pin)),
        text=text,
        path=path.absolute(),
        unlinked=MappingProxyType({name: car for name, car in cars.items() if not car.link}),
        **places,
    )


def profile_capabilities(platform: str) -> frozenset[str]:
    """Return the parts and modes of a platform's cars. For `auto`, return those of all platforms."""
    profiles = drivers.profiles_of(platform)
    return frozenset(str(word) for profile in profiles for word in (*profile.capabilities, *profile.modes))


def _resolve_car(name: str, car: Mapping[str, Any], index: int) -> FleetCar:
    platform = normalize_name(car.get("platform", AUTO))
    limits = LimitsEntry.model_validate(car.get("limits", {}))
    return FleetCar(
        name=name,
        link=car.get("link", ""),
        platform=platform,
        color=hex_color(parse_color(car["color"])) if "color" in car else default_color(name, index),
        capabilities=frozenset(word for word in profile_capabilities(platform) if not _is_without(word, car)),
        limits=Limits(**dict(limits)),
        roles=tuple(car["roles"]) if "roles" in car else None,
    )


def _resolve_pin(pin: PinEntry) -> PinRule:
    return PinRule(parse_condition(pin.when), parse_duration(pin.before), parse_duration(pin.after))


def _resolve_people(file: FileEntry) -> Mapping[str, FleetPerson]:
    """Resolve groups of cars to their members."""

    def cars(person: PersonEntry) -> tuple[str, ...] | None:
        if "drives" not in person.model_fields_set:
            return None
        named = (file.groups[each[1:]] if each.startswith("@") else [each] for each in person.drives)
        return tuple(dict.fromkeys(car for members in named for car in members))

    return MappingProxyType({name: FleetPerson(person.rank, cars(person)) for name, person in file.people.items()})


def _is_without(word: str, car: Mapping[str, Any]) -> bool:
    """Return True if the car is without this mode or part.

    `servo` stands for all servos, `drive` also for the modes in which the car drives by itself or by its remote, and
    `mode` for all modes but manual.
    """
    without = car.get("without", ())
    return (
        word in without
        or ("servo" in without and word.startswith("servo_"))
        or ("drive" in without and word in _MODES_THAT_DRIVE)
        or ("mode" in without and word in _MODES_TO_OPEN)
    )


def default_color(name: str, index: int) -> str:
    """Return the color, as #rrggbb, of a car for which the file names none."""
    return hex_color(car_color(name, index))


def _merge_layers(tree: Mapping[str, Any], car: Mapping[str, Any]) -> dict[str, Any]:
    """Merge a car's fields: the defaults, then the fields of its type, then its own fields."""
    merged: dict[str, Any] = {}
    limits: dict[str, Any] = {}
    kind = car.get("type")
    named = _as_mapping(tree.get("types")).get(kind) if isinstance(kind, str) else None
    for layer in (tree.get("defaults"), named, car):
        merged |= _as_mapping(layer)
        limits |= _as_mapping(_as_mapping(layer).get("limits"))
    return {**merged, "limits": limits}


def _resolve_path(path: Path, given: str | None) -> Path | None:
    return None if given is None else (path.absolute().parent / Path(given).expanduser()).resolve()


# Contradictions between fields. They are found in the raw data, so that they are reported together with the faults of
# single fields.


def _find_contradictions(
    tree: Mapping[str, Any], path: Path, *, unbound: bool, moved: bool
) -> Iterator[tuple[Where, str]]:
    entries = _as_mapping(tree.get("cars"))
    cars = {name: _as_mapping(car) for name, car in entries.items()}
    types = _as_mapping(tree.get("types"))
    for name, car in cars.items():
        kind = car.get("type")
        if isinstance(kind, str) and kind not in types:
            yield ("cars", name, "type"), f"there is no type {quote_value(kind)}. {suggest(kind, types)}"
        if "link" not in car and not unbound and isinstance(entries[name], Mapping):
            words = "is missing. `fleet scan` lists links, `fleet bind` finds out which car is which."
            yield ("cars", name, "link"), words
        yield from _find_car_contradictions(tree, name, car)
    yield from _find_shared_ports(cars)
    for group, members in _as_mapping(tree.get("groups")).items():
        for index, car in enumerate(members if isinstance(members, list) else ()):
            if isinstance(car, str) and car not in cars:
                yield ("groups", group, index), f"there is no car {quote_value(car)}. {suggest(car, cars)}"
    yield from _find_people_contradictions(tree, cars)
    yield from _find_pin_faults(tree)
    for entry in () if moved else ("plan", "world"):
        given = tree.get(entry)
        if isinstance(given, str) and given and given.isprintable():
            there = _resolve_path(path, given)
            if there is not None and not there.is_file():
                yield (entry,), f"there is no file {there}"


def _find_pin_faults(tree: Mapping[str, Any]) -> Iterator[tuple[Where, str]]:
    pins = tree.get("pin")
    for index, pin in enumerate(pins if isinstance(pins, list) else ()):
        when = _as_mapping(pin).get("when")
        if isinstance(when, str):
            try:
                condition = parse_condition(when)
            except BadExpression as error:
                yield ("pin", index, "when"), error.words
            else:
                if not condition.names:
                    yield ("pin", index, "when"), "names no reading. Write a condition of one, such as range_m < 0.1."


def _find_people_contradictions(tree: Mapping[str, Any], cars: Mapping[str, Any]) -> Iterator[tuple[Where, str]]:
    groups = _as_mapping(tree.get("groups"))
    for name, entry in _as_mapping(tree.get("people")).items():
        person = _as_mapping(entry)
        drives = person.get("drives")
        if person.get("rank") == PersonRank.LEAD and "drives" in person:
            yield ("people", name, "drives"), "a lead drives every car. Leave it out."
        for index, each in enumerate(drives if isinstance(drives, list) else ()):
            if not isinstance(each, str) or each in cars or (each.removeprefix("@") in groups and each[:1] == "@"):
                continue
            what, there = ("group", {f"@{group}": None for group in groups}) if each[:1] == "@" else ("car", cars)
            near = f'Did you mean "@{each}"?' if each in groups else suggest(each, there)
            yield ("people", name, "drives", index), f"there is no {what} {quote_value(each)}. {near}"


def _find_car_contradictions(tree: Mapping[str, Any], name: str, car: Mapping[str, Any]) -> Iterator[tuple[Where, str]]:
    merged = _merge_layers(tree, car)
    layers: list[tuple[Where, Any]] = [(("cars", name), car), (("defaults",), tree.get("defaults"))]
    if isinstance(car.get("type"), str):
        layers.insert(1, (("types", car["type"]), _as_mapping(tree.get("types")).get(car["type"])))
    limits = merged["limits"]
    low, critical = limits.get("battery_low_v", LOW_V), limits.get("battery_critical_v", CRITICAL_V)
    if isinstance(low, int | float) and isinstance(critical, int | float) and critical > low:
        given_limits = (
            {"battery_low_v", "battery_critical_v"} & _as_mapping(_as_mapping(layer).get("limits")).keys()
            for _, layer in layers
        )
        at = next(where for (where, _), there in zip(layers, given_limits, strict=True) if there)
        yield (*at, "limits"), f"battery_critical_v {critical:g} is above battery_low_v {low:g}. Lower it."
    platform, given = normalize_name(str(merged.get("platform", AUTO))), merged.get("without")
    if car.get("link") == LINK_SIM and platform.partition("+")[0] in (AUTO, Platform.UNKNOWN):
        kinds = ", ".join(kind for kind in drivers.built_in_platforms() if kind != Platform.UNKNOWN)
        yield ("cars", name, "platform"), f"a simulated car needs a platform. There are {kinds}."
    if car.get("link") == LINK_SIM and (why := drivers.why_not_simulated(platform)):
        yield ("cars", name, "link"), f"{why}. Give the link of a real car, or a program that behaves like one."
    if not isinstance(given, list):
        return
    try:
        had = profile_capabilities(platform)
    except ValueError:
        return  # reported as a fault of the platform
    if missing := [word for word in given if isinstance(word, str) and word in CAPABILITIES and word not in had]:
        at = next(where for where, layer in layers if {"platform", "without"} & _as_mapping(layer).keys())
        words = f"no {platform} car has {', '.join(missing)}, so the car is without it anyway"
        yield (*at, "without") if "without" in _as_mapping(dict(layers)[at]) else at, words


def _find_shared_ports(cars: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[Where, str]]:
    links: dict[str, FleetLink] = {}
    for name, car in cars.items():
        given = car.get("link")
        if isinstance(given, str):
            try:
                links[name] = parse_fleet_link(given)
            except BadLink:
                continue  # reported as a fault of the link
    for first, second in shared_ports(links):
        words = f"{first} and {second} have the same port. Each car needs its own."
        yield ("cars", second, "link"), words


def _as_mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
