"""What the coordinator knows of the cars, as values, and what a plan's expressions may name of it. Pure.

How it is heard is coordinator.py's, what follows from it decide.py's.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor

from fleet.conditions import Expression
from gateway.protocol.platforms import Profile, parse_platform
from schemas import messages, topics

CONTRADICTED: Final = "contradicted"
LOST: Final = "lost"
_HEADER: Final = frozenset({"stamp", "car", "seq", "boot_id"})


def _fields() -> dict[str, tuple[str, str, type]]:
    found: dict[str, tuple[str, str, type]] = {}
    kinds = {FieldDescriptor.CPPTYPE_BOOL: bool, FieldDescriptor.CPPTYPE_STRING: str}
    for name, topic in topics.TOPICS.items():
        if topic.family not in ("sensor", "state"):
            continue
        # Any: the stubs know two kinds of descriptor.
        descriptors: Any = messages.message_class(topic.message).DESCRIPTOR.fields
        for each in descriptors:
            if each.name not in _HEADER and not each.is_repeated and each.message_type is None:
                kind = kinds.get(each.cpp_type, float)
                found[f"{name.partition('/')[2]}.{each.name}"] = (name, each.name, kind)
    return found


_FIELDS: Final = _fields()
NAMES: Final[Mapping[str, type]] = MappingProxyType({name: kind for name, (_, _, kind) in _FIELDS.items()})
"""What an expression of a plan may name: `battery.voltage_v`, `light.left`, `mode.asked`, and its type."""


_STALE_S: Final = {
    topic: math.inf if (after_s := topics.TOPICS[topic].stale_after_s) is None else after_s
    for topic, _, _ in _FIELDS.values()
}


def topic_of(name: str) -> str:
    """The topic in which a name of NAMES is published."""
    return _FIELDS[name][0]


@dataclass(frozen=True, slots=True)
class Observation:
    """The fields of one reading that were measured, and when it came."""

    fields: Mapping[str, object]
    at: float


@dataclass(frozen=True, slots=True)
class Refusal:
    """What a car's gateway said no to."""

    mode: str
    reason: str
    words: str
    at: float


@dataclass(frozen=True, slots=True)
class CarSnapshot:
    """What is known of one car."""

    present: bool = False
    """Its gateway is on the bus."""
    mode: str = ""
    """The mode it was last asked for, as its gateway says; empty: not heard yet."""
    verdict: str = ""
    evidence: str = ""
    motors: str = ""
    link: str = ""
    """As its gateway says; empty: not heard yet."""
    platform: str = ""
    """As its gateway or the fleet file says; empty: not known."""
    capabilities: frozenset[str] = frozenset()
    estopped_by: str | None = None
    held_by: str | None = None
    driven_by: str | None = None
    """Who holds a motion or a lease; a coordinator never does."""
    roles: frozenset[str] | None = None
    """The roles that the fleet file lets it take; None: any."""
    listed: bool = False
    """It stands in the fleet file."""
    refused: Refusal | None = None
    busy: bool = False
    """Something was asked of it, and there is no outcome yet."""

    @property
    def profile(self) -> Profile | None:
        """What its platform can do; None if that is not known."""
        return _profile(self.platform)

    def lacks(self, mode: str) -> bool:
        """Whether it is known not to do this mode, by its platform or by the fleet file."""
        profile = self.profile
        return (profile is not None and mode not in profile.modes) or (self.listed and mode not in self.capabilities)


@cache
def _profile(platform: str) -> Profile | None:
    try:
        return parse_platform(platform) if platform else None
    except ValueError:  # of a gateway that is newer than this
        return None


NOBODY: Final = CarSnapshot()


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """What the coordinator knows."""

    cars: Mapping[str, CarSnapshot] = field(default_factory=dict)
    readings: Mapping[str, Mapping[str, Observation]] = field(default_factory=dict)
    """By car and topic."""

    def holds(self, expression: Expression, car: str, now: float, *, old: bool = False) -> bool | None:
        """Whether it is so of this car; None: not known. A value too old to say how things are is none, unless `old`.

        `old` is for what changes slowly: a mode that does not measure it leaves the last value standing.
        """
        seen = self.readings.get(car)
        if seen is None:
            return None

        def lookup(name: str) -> object | None:
            topic, member, _ = _FIELDS[name]
            one = seen.get(topic)
            if one is None:
                return None
            if not old and now - one.at > _STALE_S[topic]:
                return None
            return one.fields.get(member)

        return expression.value(lookup)

    def used(self, expression: Expression, car: str, now: float) -> tuple[str, ...]:
        """The readings that it looks at, each with its value and age: for a person."""
        told = []
        for name in dict.fromkeys(expression.names):
            topic, member, _ = _FIELDS[name]
            one = self.readings.get(car, {}).get(topic)
            if one is None or member not in one.fields:
                told.append(f"{car}/{topic} {member} not measured")
            else:
                told.append(f"{car}/{topic} {member}={shown(one.fields[member])} ({max(0.0, now - one.at):.1f} s old)")
        return tuple(told)


def shown(value: object) -> str:
    """A value as an expression has it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
