"""A snapshot of the fleet as the coordinator knows it, and the names that a plan's expressions may use. Pure.

observer.py fills the snapshot, decide.py decides by it.
"""

import math
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.conditions import Expression, aliases_of, compared_in, fields_of
from fleet.conditions.functions import FUNCTIONS, ConditionFunction, split_call
from gateway import drivers
from schemas import messages, topics
from schemas.car_profile import CarProfile
from schemas.commands import Verb
from schemas.messages import Observation
from schemas.words import Motors, Verdict

_HEADER: Final = frozenset({"stamp", "car", "seq", "boot_id"})


@cache
def _fields_of(message_class: Any) -> Mapping[str, type]:
    return fields_of(message_class)


class _Field(Struct, frozen=True):
    """The meaning of a name in an expression: a field of a topic, or a function of that field."""

    topic: str
    member: str
    kind: type
    function: ConditionFunction | None = None

    def value(self, seen: Observation) -> Any:
        """Return the value of the field or function. None if it was not measured."""
        if self.function is not None:
            readings = ((each.at, self._measured(each)) for each in (*seen.earlier, seen))
            return self.function.evaluate([(at, value) for at, value in readings if value is not None])
        return self._measured(seen)

    def _measured(self, seen: Observation) -> Any:
        # The message may come from a recording, with the schema of another version or of another project.
        return compared_in(seen.message)(self.member) if self.is_in(seen.message) else None

    def is_in(self, message: Any) -> bool:
        """Return True if the schema of a message has this field, with its type."""
        schema: Any = type(message)
        return _fields_of(schema).get(self.member) is self.kind


class _Fields(dict[str, _Field]):
    """The fields by name. A function of a field is added when a plan names it."""

    def __missing__(self, name: str) -> _Field:
        function, field_name = split_call(name)
        if not function:
            raise KeyError(name)
        found = self[name] = replace(self[field_name], function=FUNCTIONS[function])
        return found


def _fields() -> _Fields:
    result = _Fields()
    for name, topic in topics.TOPICS.items():
        if topic.family not in ("sensor", "state"):
            continue
        for member, kind in fields_of(messages.message_class(topic.message)).items():
            if member not in _HEADER:
                result[f"{name.partition('/')[2]}.{member}"] = _Field(name, member, kind)
    return result


_FIELDS: Final = _fields()
NAMES: Final[Mapping[str, type]] = MappingProxyType({name: each.kind for name, each in _FIELDS.items()})
"""The names that a plan's expressions may use (`battery.voltage_v`, `light.left`, `mode.asked`), with their types."""
ALIASES: Final[Mapping[str, str]] = MappingProxyType(aliases_of(NAMES))
"""Other spellings of NAMES: `voltage_v`, `battery_v`."""
_STALE_S: Final = {
    each.topic: math.inf if (after_s := topics.TOPICS[each.topic].stale_after_s) is None else after_s
    for each in _FIELDS.values()
}


def topic_of(name: str) -> str:
    """Return the topic of one of NAMES, or of a function of one."""
    return _FIELDS[name].topic


def value_of(name: str, seen: Observation) -> Any:
    """Return the value that a name, or a function of it, has in a message of its topic. None if it was not measured."""
    return _FIELDS[name].value(seen)


def is_in(name: str, message: Any) -> bool:
    """Return True if the schema of a message has the field of a name, with the type that it has in a condition."""
    return _FIELDS[name].is_in(message)


class Refusal(Struct, frozen=True):
    """A mode command that was not carried out, and why: the gateway refused it, or did not answer."""

    mode: str
    reason: str
    words: str
    at: float


class CarSnapshot(Struct, frozen=True):
    """The coordinator's knowledge of one car."""

    present: bool = False
    """True if the car's gateway is on the bus."""
    mode: str = ""
    """The last mode that the car was commanded into, as its gateway reports. Empty if there is no report yet."""
    verdict: str = ""
    evidence: str = ""
    motors: str = ""
    doubted: bool = False
    """True if the car has shown its stops before, but not the last one. Always False for a car that cannot show
    stops."""
    link: str = ""
    """The state of the car's link, as its gateway reports. Empty if there is no report yet."""
    platform: str = ""
    """The platform, from the car's gateway or the fleet file. Empty if it is not known."""
    capabilities: frozenset[str] = frozenset()
    estopped_by: str | None = None
    paused_by: str | None = None
    """Who paused the whole fleet."""
    lent_to: str | None = None
    held_by: str | None = None
    driven_by: str | None = None
    """The holder of a motion or a lease; never a coordinator."""
    roles: frozenset[str] | None = None
    """The roles that the fleet file lets the car have, or None if it may have any role."""
    listed: bool = False
    """True if the fleet file lists the car."""
    refused: Refusal | None = None
    """The refusal of the last mode command. None if that command was carried out."""
    refused_before: tuple[Refusal, ...] = ()
    """The refusals of other modes, which the car has not accepted since."""
    busy: bool = False
    """True if a mode command to the car has no outcome yet."""

    @property
    def taken_by(self) -> str | None:
        """The person who has taken the car from the coordinator until a person releases it, or None."""
        return self.estopped_by or self.paused_by or self.lent_to or self.held_by

    @property
    def profile(self) -> CarProfile | None:
        """The profile of the car's platform, or None if the platform is not known."""
        return _profile(self.platform)

    def with_outcome(self, mode: str, refusal: Refusal | None) -> "CarSnapshot":
        """Return the car after the outcome of a command for this mode. `refusal` is None if it was carried out."""
        before = [each for each in (self.refused, *self.refused_before) if each is not None and each.mode != mode]
        if refusal is not None:
            # A car that refuses again, such as for its battery, would still refuse the modes that it has refused
            # before. If these were tried again one by one, a role would move from car to car each time.
            before = [replace(each, at=refusal.at) for each in before]
        return replace(self, refused=refusal, refused_before=tuple(before))

    def refusal_of(self, mode: str) -> Refusal | None:
        """Return the last refusal of this mode. None if the car has accepted the mode since."""
        refusals = (self.refused, *self.refused_before)
        return next((each for each in refusals if each is not None and each.mode == mode), None)

    def is_in_mode(self, mode: str) -> bool:
        """Return True if the car was commanded into this mode last, and its readings do not contradict it."""
        return self.mode == mode and self.verdict != Verdict.CONTRADICTED

    def is_confirmed_in(self, mode: str) -> bool:
        """Return True if the car was commanded into this mode last, and its readings confirm it."""
        return self.mode == mode and self.verdict == Verdict.CONFIRMED

    def lacks(self, mode: str) -> bool:
        """Return True if the car's platform does not know this mode, or the fleet file forbids it."""
        profile = self.profile
        return (profile is not None and mode not in profile.modes) or (self.listed and mode not in self.capabilities)

    @property
    def lacks_led(self) -> bool:
        """Return True if the car's platform has no color LED, or the fleet file says that the car is without it."""
        profile = self.profile
        has_none = profile is not None and Verb.LED not in profile.capabilities
        return has_none or (self.listed and Verb.LED not in self.capabilities)


@cache
def _profile(platform: str) -> CarProfile | None:
    try:
        return drivers.profile_of(platform) if platform else None
    except ValueError:  # from a gateway that is newer than this coordinator
        return None


UNKNOWN_CAR: Final = CarSnapshot()


def may_move_by_plan(known: CarSnapshot, *, sent_off: bool) -> bool:
    """Return True if a car of a plan may still be moving, and no person has taken it.

    sent_off: the plan has commanded it into a mode in which it moves, so it may move although its gateway is gone.
    """
    is_free = known.taken_by is None and known.driven_by is None
    return is_free and (known.motors != Motors.OFF if known.present else sent_off)


class FleetSnapshot(Struct, frozen=True):
    """The coordinator's knowledge of all cars."""

    cars: Mapping[str, CarSnapshot] = field(default_factory=dict)
    readings: Mapping[str, Mapping[str, Observation]] = field(default_factory=dict)
    """The newest messages, by car and topic."""

    def holds(self, expression: Expression, car: str, now: float, *, old: bool = False) -> bool | None:
        """Return whether the expression is true for this car, or None if that is not known.

        Stale values count as not measured. With `old`, the last value counts instead: for values that change slowly, in
        a mode in which the car does not measure them.
        """
        seen = self.readings.get(car)
        if seen is None:
            return None

        def lookup(name: str) -> object | None:
            what = _FIELDS[name]
            observation = seen.get(what.topic)
            if observation is None or (not old and now - observation.at > _STALE_S[what.topic]):
                return None
            value: object = what.value(observation)
            return value

        return expression.value(lookup)

    def describe_readings(self, expression: Expression, car: str, now: float) -> tuple[str, ...]:
        """Return texts for a person: the readings that an expression uses, each with its value and age."""
        lines = []
        for name in dict.fromkeys(expression.names):
            what = _FIELDS[name]
            observation = self.readings.get(car, {}).get(what.topic)
            value = None if observation is None else what.value(observation)
            text = f"{what.function.name}({what.member})" if what.function is not None else what.member
            if observation is None or value is None:
                lines.append(f"{car}/{what.topic} {text} not measured")
            else:
                age_s = max(0.0, now - observation.at)
                lines.append(f"{car}/{what.topic} {text}={format_reading(value)} ({age_s:.1f} s old)")
        return tuple(lines)


def format_reading(value: object) -> str:
    """Format a value for a person: floats with 4 digits, words without quotes."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
