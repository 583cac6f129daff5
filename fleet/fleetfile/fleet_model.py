"""The models of a fleet file, field by field. Pure.

fleet_file.py checks contradictions between fields.
"""

import re
from enum import StrEnum
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from fleet.fleet_links import parse_fleet_link
from fleet.quota import Quota, parse_size
from gateway import drivers
from schemas import bus, keys
from schemas.battery_levels import CRITICAL_V, EMPTY_V, FULL_V, LOW_V
from schemas.colors import COLOR_PATTERN, parse_color
from schemas.duration import DURATION_PATTERN, parse_duration
from schemas.limits import DEFAULT_MAX_DRIVE_S
from schemas.links import BadLink
from schemas.platform_name import AUTO, HEAD, HEAD_PATTERN, OPTIONS, VARIANTS
from schemas.words import BatteryAction, Mode
from schemas.yaml_document.document import Entry
from schemas.yaml_document.fault_words import quote_value

MIN_PIN_S: Final = 1.0
"""Minimum time before and after a pinned moment. The recorder writes its pins only once a second."""
MAX_PIN_S: Final = 3600.0
"""Maximum time before and after a pinned moment: the longest lesson."""
MAX_PIN_RULES: Final = 50
"""Maximum number of conditions for pins. The recorder evaluates each for every reading that it names."""


class PersonRank(StrEnum):
    """The rank of a person."""

    LEAD = "lead"
    PERSON = "person"


def validate_name(name: str) -> str:
    """Return the name of a car, type, role or fleet. Raises ValueError if it is not valid."""
    return keys.check_name(name, "name")


def validate_car_name(name: str) -> str:
    """Return the name of a car. Raises ValueError if it is not valid."""
    if name == "all":
        raise ValueError("no car can be called all: `fleet stop all` stops every car")
    return validate_name(name)


def validate_driven(name: str) -> str:
    """Return a car or @group. Raises ValueError if it is not valid."""
    return f"@{validate_name(name[1:])}" if name.startswith("@") else validate_car_name(name)


def validate_link(text: str) -> str:
    """Return a link. Raises ValueError if parse_fleet_link does not accept it."""
    try:
        parse_fleet_link(text)
    except BadLink as error:
        raise ValueError(f"{quote_value(text)}: {error}") from None
    return text


def validate_platform(text: str) -> str:
    """Return a platform (or auto). Raises ValueError if it is not valid."""
    drivers.check_platform(text)
    return text


def validate_endpoint(text: str) -> str:
    """Return the bus endpoint. Raises ValueError if it is not valid."""
    if not text:
        raise ValueError("'' is not allowed: write tcp/HOST:PORT, or leave it out")
    try:
        return bus.resolve_endpoint(text)
    except bus.BadEndpoint as error:  # pydantic reports only a ValueError as a fault of the file
        raise ValueError(str(error).removeprefix("endpoint ")) from None


def validate_color(text: str) -> str:
    """Return a color. Raises ValueError if it is neither a name nor #rrggbb."""
    parse_color(text)
    return text


def validate_size(text: str) -> str:
    """Return a size such as 20GB. Raises ValueError if it is not valid."""
    if _SIZE.match(text) is None:
        raise ValueError(f"{quote_value(text)} is not a size. Write 500MB or 20GB.")
    return text


def validate_path(text: str) -> str:
    """Return a path. Raises ValueError if it is not printable."""
    if not text or not text.isprintable():
        raise ValueError(f"{quote_value(text)} is not allowed: write a path, relative to this file")
    return text


def validate_pin_time(text: str) -> str:
    """Return the time before or after a pinned moment. Raises ValueError if it is not valid."""
    parse_duration(text, MIN_PIN_S, MAX_PIN_S)
    return text


PARTS: Final = frozenset().union(*(each.capabilities for each in drivers.built_in_profiles()))
CAPABILITIES: Final = tuple(sorted(PARTS | set(Mode)))
Capability = StrEnum("Capability", {word: word for word in CAPABILITIES})  # type: ignore[misc]  # the words are the platforms' own
_SIZE: Final = re.compile("^([1-9][0-9]{0,5} ?[MG]|[1-9][0-9]{0,2} ?T)B$")
_OPTIONS: Final = "|".join((*sorted(OPTIONS), *VARIANTS, f"{HEAD}={HEAD_PATTERN}"))
_PLATFORMS: Final = f"^({'|'.join((AUTO, *drivers.built_in_platforms()))})([+]({_OPTIONS}))*$"

_Name = Annotated[
    str, AfterValidator(validate_name), Field(json_schema_extra={"pattern": "^[a-z0-9][a-z0-9_-]{0,31}$"})
]
_CarName = Annotated[
    str, AfterValidator(validate_car_name), Field(json_schema_extra={"pattern": "^(?!all$)[a-z0-9][a-z0-9_-]{0,31}$"})
]
_Driven = Annotated[
    str, AfterValidator(validate_driven), Field(json_schema_extra={"pattern": "^(?!all$)@?[a-z0-9][a-z0-9_-]{0,31}$"})
]
_Link = Annotated[str, AfterValidator(validate_link), Field(examples=["/dev/ttyUSB0", "tcp://192.168.1.7:8888"])]
_Platform = Annotated[str, AfterValidator(validate_platform), Field(json_schema_extra={"pattern": _PLATFORMS})]
_Color = Annotated[str, AfterValidator(validate_color), Field(json_schema_extra={"pattern": COLOR_PATTERN})]
_Size = Annotated[str, AfterValidator(validate_size), Field(json_schema_extra={"pattern": _SIZE.pattern})]
_Path = Annotated[str, AfterValidator(validate_path)]
_PinTime = Annotated[str, AfterValidator(validate_pin_time), Field(json_schema_extra={"pattern": DURATION_PATTERN})]
_Volts = Annotated[float, Field(ge=EMPTY_V, le=FULL_V)]


class LimitsEntry(Entry):
    """The limits of a car."""

    longest_drive_s: float = Field(
        default=DEFAULT_MAX_DRIVE_S, gt=0, le=3600, description="longest duration of one drive command, seconds"
    )
    speed_max: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="highest speed of drives, as a share of the car's top speed; in a mode, a car drives at the speed "
        "of its own program",
    )
    battery_low_v: _Volts = Field(
        default=LOW_V,
        description="the battery is low below this voltage with the motors off, volts; with three cells, 1.5 "
        "times this",
    )
    battery_critical_v: _Volts = Field(
        default=CRITICAL_V,
        description="the battery is critical below this voltage with the motors off, volts; with three cells, 1.5 "
        "times this",
    )
    on_battery_low: BatteryAction = Field(
        default=BatteryAction.WARN,
        description="reaction to a low battery. Most cars report their voltage only in mode manual. "
        "warn: log it; refuse: also refuse new drives and modes; stop: also stop the car",
    )
    on_battery_critical: BatteryAction = Field(
        default=BatteryAction.REFUSE, description="reaction to a critical battery, as for a low one"
    )


class CommonEntry(Entry):
    """Fields that `defaults`, each type and each car can have."""

    # These defaults are only shown by editors, or are empty. fleet_file.py merges the layers of the file itself.
    platform: _Platform = Field(
        default=AUTO,
        description="the kind of program that runs on the car, with options, such as arduino+arm; auto: the gateway "
        "detects it",
    )
    color: _Color = Field(
        default_factory=str,
        description='color in tables and pictures: red, or "#e01b24" in quotes; left out: the color that the car is '
        "named after, else one of six",
    )
    without: list[Capability] = Field(
        default_factory=list,
        description="modes and parts of the car that are broken or absent, so that the plan does not use them. servo: "
        "all servos; drive: also the modes in which the car drives; mode: all modes but manual",
    )
    limits: LimitsEntry = Field(default_factory=LimitsEntry, description="limits of speed, time and battery")
    roles: list[_Name] = Field(
        default_factory=list,
        description="the only roles of the plan that the car may have; left out: any. Even so, a rule of the plan may "
        "give the car a mode",
    )


class CarEntry(CommonEntry):
    """One car."""

    type: str = Field(default_factory=str, description="name of one of the `types`")
    link: _Link = Field(default_factory=str, description="address of the car; `fleet scan` shows links")


class PersonEntry(Entry):
    """The rights of a person. Everyone may watch, stop and emergency-stop every car."""

    rank: PersonRank = Field(
        default=PersonRank.PERSON,
        description="lead: drives every car, outranks all others, and may pause the fleet and lend cars",
    )
    drives: list[_Driven] = Field(
        default_factory=list,
        description='cars and groups that this person may drive, such as `[red, "@a"]`; left out: all cars',
    )


class RecordEntry(Entry):
    """Where `fleet up` records, and how much of that is kept."""

    to: _Path = Field(default_factory=str, description="the directory of sessions, relative to this file")
    quota: _Size = Field(
        default_factory=str,
        description="maximum size of all sessions in that directory, such as 20GB; beyond it, the oldest minutes are "
        "removed, but never a marked session",
    )

    @property
    def limits(self) -> Quota:
        """Return the limits of the recordings."""
        return Quota(total=parse_size(self.quota) or 0)


class PinEntry(Entry):
    """A condition. What was recorded around the times at which it is true is kept longest."""

    when: str = Field(
        description="the condition, written as in plans: `mode.verdict == 'contradicted'`. It is met if it is true for "
        "at least one car"
    )
    before: _PinTime = Field(
        default="30s", description="how long before the condition became true the kept time begins: 1s to 1h"
    )
    after: _PinTime = Field(
        default="30s", description="how long after the condition was last true the kept time ends: 1s to 1h"
    )


class ConsoleEntry(Entry):
    """The web page of `fleet up`."""

    port: int = Field(default=0, ge=0, le=65535, description="port at which the page is served; 0: the usual one, 7480")


class FileEntry(Entry):
    """A fleet of cars, for `fleet up`."""

    name: _Name = Field(
        default=keys.DEFAULT_FLEET, description="name of the fleet, the first part of every key on the bus"
    )
    endpoint: Annotated[str, AfterValidator(validate_endpoint)] = Field(
        default_factory=str,
        description="address of the bus, tcp/HOST:PORT; left out: FLEET_ENDPOINT, else the hub that you have joined, "
        "else a hub on this computer",
    )
    plan: _Path = Field(default_factory=str, description="the file with the plan: what the cars do together")
    record: bool | RecordEntry = Field(
        default=True,
        description="true: `fleet up` records; false: it does not; or a Record, which says where, and how much is kept",
    )
    pin: list[PinEntry] = Field(
        default_factory=list,
        max_length=MAX_PIN_RULES,
        description="conditions, such as `[{when: range_m < 0.1}]`. Beyond the quota, what was recorded around the "
        "times at which one is true, and around stops and marks, is removed last; but at most half of the quota is "
        "kept for all that",
    )
    console: bool | ConsoleEntry = Field(
        default=False, description="true: `fleet up` serves the web page; or `{port: 8080}`, which also sets its port"
    )
    world: _Path = Field(default_factory=str, description="the world file: where simulated cars drive")
    defaults: CommonEntry = Field(
        default_factory=CommonEntry, description="values for every car that does not set them itself"
    )
    types: dict[_Name, CommonEntry] = Field(
        default_factory=dict,
        description="kinds of cars: values for every car with this `type`, which override the defaults",
    )
    groups: dict[_Name, list[_Name]] = Field(
        default_factory=dict,
        description="groups of cars, such as `a: [red, blue]`, which commands can name: `fleet stop @a`",
    )
    people: dict[_Name, PersonEntry] = Field(
        default_factory=dict,
        description="the people who may drive, such as `group_a: {drives: [red]}`; all others may only watch and stop. "
        "Left out: everyone may drive",
    )
    cars: dict[_CarName, CarEntry] = Field(
        description="the cars, at least one, such as `red: {link: /dev/ttyUSB0}`", min_length=1
    )
