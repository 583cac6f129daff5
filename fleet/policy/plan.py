"""A plan: which mode each car should be in, and rules that change it. Reads and checks the text; decides nothing. Pure.

The text is YAML as people read it, not YAML 1.1: `on`, `no` and `off` are words, `010` and `1:30` are no numbers, a key
given twice is a mistake.
"""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Final, Never

import yaml
from google.protobuf.descriptor import FieldDescriptor

from gateway.protocol.values import Mode
from schemas import keys, messages, topics

_READINGS: Final = tuple(name for name, topic in topics.TOPICS.items() if topic.family in ("sensor", "state"))
_LARGEST: Final = 1e12
"""No reading comes near it; a whole number beyond what a float holds would not even compare."""
_HEADER: Final = frozenset({"stamp", "car", "seq", "boot_id"})


class BadPlan(ValueError):
    """A plan that cannot be followed; its text names the file, the place, the value and what is allowed."""


class Comparison(StrEnum):
    """How a field is compared."""

    BELOW = "below"
    ABOVE = "above"
    EQUALS = "equals"


@dataclass(frozen=True, slots=True)
class Condition:
    """True while a fresh reading's field passes the test, and has for `for_s` seconds."""

    car: str
    reading: str
    field: str
    test: Comparison
    value: float | str | bool
    for_s: float

    def holds(self, value: object) -> bool:
        """Whether a value of the field passes the test."""
        if self.test is Comparison.EQUALS:
            return value == self.value
        assert isinstance(self.value, float)
        if not isinstance(value, int | float):
            return False
        return value < self.value if self.test is Comparison.BELOW else value > self.value

    def __str__(self) -> str:
        sign = {Comparison.BELOW: "<", Comparison.ABOVE: ">", Comparison.EQUALS: "="}[self.test]
        lasting = f" for {self.for_s:g} s" if self.for_s else ""
        return f"{self.car}/{self.reading} {self.field} {sign} {_shown(self.value)}{lasting}"


@dataclass(frozen=True, slots=True)
class Rule:
    """While the condition is true, the car should be in this mode instead of its planned one."""

    when: Condition
    car: str
    mode: Mode


@dataclass(frozen=True, slots=True)
class Plan:
    """What the coordinator keeps true. Of several rules for one car the first that is true counts."""

    cars: Mapping[str, Mode]
    rules: tuple[Rule, ...]
    text: str

    @property
    def version(self) -> str:
        """The same for the same text."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]


def parse(text: str, source: str = "plan") -> Plan:
    """The plan in a text; raises BadPlan. `source` is its name in errors, usually the file's path."""
    try:
        tree = yaml.load(text, Loader=_Loader)  # noqa: S506 - _Loader is a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark is not None else "the text"
        raise BadPlan(f"{source}: {where}: {error.problem or error.context}: a plan is YAML") from None
    except yaml.YAMLError as error:  # a character that YAML does not allow
        raise BadPlan(f"{source}: {' '.join(str(error).split())}: a plan is YAML") from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        # What PyYAML raises for a tag whose text is not of its type (`!!int zz`), a number without an end, a deep nest.
        raise BadPlan(
            f"{source}: a tag, a number or a nest that no plan needs: write words, numbers and `car: mode`"
        ) from None
    root = _Place(source, "", tree)
    fields = root.mapping(required=("cars",), optional=("rules",))
    cars = fields["cars"].names()
    if not cars:
        fields["cars"].bad("at least one car with its mode, as `red: tracking`")
    rules = fields["rules"].items() if "rules" in fields else []
    return Plan(
        cars=MappingProxyType({car: place.one_of(Mode) for car, place in cars.items()}),
        rules=tuple(_rule(place, tuple(cars)) for place in rules),
        text=text,
    )


def _rule(place: "_Place", cars: Sequence[str]) -> Rule:
    parts = place.mapping(required=("when", "then"))
    then = parts["then"].mapping(required=("car", "mode"))
    car = then["car"].word(cars)
    return Rule(_condition(parts["when"]), car, then["mode"].one_of(Mode))


def _condition(place: "_Place") -> Condition:
    given = place.mapping(required=("car", "reading", "field"), optional=(*Comparison, "for_s"))
    tests = [test for test in Comparison if test in given]
    if len(tests) != 1:
        place.bad(f"exactly one of {', '.join(Comparison)}")
    reading = given["reading"].word(_READINGS)
    fields = {
        field.name: field
        for field in messages.message_class(topics.TOPICS[reading].message).DESCRIPTOR.fields
        if field.name not in _HEADER and not field.is_repeated and field.message_type is None
    }
    name = given["field"].word(tuple(fields))
    test = tests[0]
    return Condition(
        car=given["car"].name(),
        reading=reading,
        field=name,
        test=test,
        value=_value(given[test], fields[name], test),
        for_s=given["for_s"].number(least=0.0) if "for_s" in given else 0.0,
    )


def _value(place: "_Place", field: Any, test: Comparison) -> float | str | bool:
    """What the field is compared with, of the field's own type. Any: the stubs know two kinds of descriptor."""
    kind = field.cpp_type
    if kind == FieldDescriptor.CPPTYPE_BOOL or kind == FieldDescriptor.CPPTYPE_STRING:
        if test is not Comparison.EQUALS:
            place.bad(f"{field.name} is no number: only equals can be asked of it")
        wanted = bool if kind == FieldDescriptor.CPPTYPE_BOOL else str
        if not isinstance(place.value, wanted):
            place.bad("true or false" if wanted is bool else f"a word, as {field.name} has it")
        return place.value
    return place.number()


@dataclass(frozen=True, slots=True)
class _Place:
    """A value in the plan, and where it stands."""

    source: str
    path: str
    value: Any

    def bad(self, allowed: str) -> Never:
        at = f" {self.path}:" if self.path else ""
        raise BadPlan(f"{self.source}:{at} {_shown(self.value)} is not allowed: {allowed}")

    def mapping(self, *, required: Sequence[str], optional: Sequence[str] = ()) -> "dict[str, _Place]":
        """The named parts."""
        if not isinstance(self.value, dict):
            self.bad(f"a mapping with {', '.join(required)}")
        known = (*required, *optional)
        for name in self.value:
            if name not in known:
                raise BadPlan(f"{self._at(name)}: there is no such entry here: {', '.join(known)}")
        for name in required:
            if name not in self.value:
                raise BadPlan(f"{self._at(name)}: it is missing here")
        return {name: self._below(name, value) for name, value in self.value.items()}

    def names(self) -> "dict[str, _Place]":
        """A mapping whose keys are cars."""
        if not isinstance(self.value, dict):
            self.bad("a mapping of cars to modes, as `red: tracking`")
        return {self._below(str(key), key).name(): self._below(str(key), value) for key, value in self.value.items()}

    def items(self) -> "list[_Place]":
        """The entries of a list; nothing is an empty list."""
        if self.value is None:
            return []
        if not isinstance(self.value, list):
            self.bad("a list, each entry with when and then")
        return [_Place(self.source, f"{self.path}[{index}]", item) for index, item in enumerate(self.value)]

    def name(self) -> str:
        """A car's name."""
        if not isinstance(self.value, str):
            self.bad(f"a car's name in quotes, {keys.NAME_RULE}")
        try:
            return keys.check_name(self.value)
        except keys.BadKey:
            self.bad(f"a car's name is {keys.NAME_RULE}")

    def word(self, allowed: Sequence[str]) -> str:
        """One of the allowed words."""
        if self.value not in allowed:
            self.bad(f"one of {', '.join(allowed)}")
        return str(self.value)

    def one_of(self, kind: type[Mode]) -> Mode:
        """One of an enumeration."""
        return kind(self.word(tuple(kind)))

    def number(self, *, least: float = -math.inf) -> float:
        """A finite number."""
        value = self.value
        if isinstance(value, int) and abs(value) > _LARGEST:
            self.bad("a number of a reading's size")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < least:
            self.bad("a number" if least == -math.inf else f"a number, {least:g} or more")
        return float(value)

    def _below(self, name: str, value: Any) -> "_Place":
        return _Place(self.source, f"{self.path}.{name}" if self.path else name, value)

    def _at(self, name: object) -> str:
        return f"{self.source}: {self._below(str(name), None).path}"


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:g}"
    return repr(value) if value is not None else "nothing"


class _Loader(yaml.SafeLoader):
    """The safe loader with YAML 1.2's few plain types instead of 1.1's many, and no key twice."""

    yaml_implicit_resolvers: Final[dict[str, list[tuple[str, re.Pattern[str]]]]] = {}  # type: ignore[misc]  # the stub has none

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:  # noqa: FBT001, FBT002 - PyYAML's signature
        """A mapping; raises ConstructorError for a key given twice."""
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
            if key is None or key in seen:
                problem = "a key that is no word" if key is None else f"{key!r} is given twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


for _tag, _pattern, _first in (
    ("null", r"~|null|", ["~", "n", ""]),
    ("bool", r"true|false", ["t", "f"]),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    ("float", r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first)
