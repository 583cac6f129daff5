"""Parses a plan's text and reports all its faults at once, with line and column. Pure."""

from collections.abc import Collection, Iterable
from types import MappingProxyType
from typing import Final

from fleet.conditions import BadExpression, Expression
from fleet.conditions import parse as parse_expression
from fleet.conditions.functions import FUNCTIONS
from fleet.policy.plan.plan import (
    ALL_CARS,
    OTHER_CARS,
    RESERVED,
    THIS_CAR,
    Effect,
    Plan,
    PlanCondition,
    PlanPhase,
    Quantifier,
    Role,
    Rule,
)
from fleet.policy.plan.plan_model import (
    BlinkEntry,
    Condition,
    ConditionEntry,
    EffectEntry,
    GivenBy,
    PhaseEntry,
    PlanEntry,
    RoleEntry,
    RuleEntry,
    WithoutRole,
)
from fleet.policy.snapshot import ALIASES, NAMES
from gateway import drivers
from schemas import keys
from schemas.colors import parse_color
from schemas.words import Mode
from schemas.yaml_document.document import BadFile, Document
from schemas.yaml_document.fault_words import Where, suggest

BadPlan = BadFile
"""Raised for a plan with faults. The text has one line for each fault, with file, line and column."""
PARTS: Final = frozenset().union(*(each.capabilities for each in drivers.built_in_profiles()))
_MISSING: Final = {"mode": Mode.MANUAL, "when": "true", "then": []}
"""Values for missing required fields, so that the rest of a file can be checked."""


def parse(text: str, source: str = "plan") -> Plan:
    """Parse a plan. Raises BadPlan with all faults. `source` is the plan's name in errors, usually its path."""
    return parse_entry(text, source)[1]


def parse_entry(text: str, source: str = "plan") -> tuple[PlanEntry, Plan]:
    """Parse a plan as `parse` does. Return its entries as written, too."""
    document = Document(text, source)
    entry = document.validate(PlanEntry) or document.validate_partial(PlanEntry, _MISSING)
    if entry is None:
        document.raise_faults()
    assert entry is not None  # `raise_faults` raises if there is no entry
    plan = _PlanParser(document, entry).plan(text)
    document.raise_faults()
    return entry, plan


class _PlanParser:
    """Makes a plan from the entries, and reports contradictions between them."""

    def __init__(self, document: Document, entry: PlanEntry) -> None:
        self._document = document
        self._entry = entry
        self._places: dict[str, tuple[int, int]] = {}
        self._fixed = {car: each.role or str(each.mode or "") for car, each in entry.fixed.items()}

    def plan(self, text: str) -> Plan:
        entry = self._entry
        if not entry.fixed and not entry.roles:
            words = "a plan needs roles. Write: `roles: {patrol: {mode: obstacle_avoidance}}`"
            self._report((), words, unless=())
        for place, names in (("roles", entry.roles), ("fixed", entry.fixed), ("phases", entry.phases)):
            for name in names:
                self._mark({"fixed": "car"}.get(place, place[:-1]), name, (place, name), on_key=True)
                self._check_own_name((place, name), name, on_key=True)
        for name in entry.roles:
            if name in entry.fixed:
                self._report(("roles", name), "a car in `fixed` has this name: a rule could mean either", on_key=True)
            elif any(each.mode == name for each in entry.fixed.values()):
                self._report(("roles", name), "a mode that `fixed` uses has this name: choose another", on_key=True)
        roles = {name: self._role(name, each) for name, each in entry.roles.items()}
        for car, each in entry.fixed.items():
            if (each.role is None) is (each.mode is None):
                needed = "needs a role or a mode. Write: `{mode: manual}`"
                words = "has a role and a mode. Write one of them." if each.role else needed
                self._report(("fixed", car), words, unless=("fixed", car))
            elif each.role is not None:
                self._check_role(("fixed", car, "role"), each.role)
            elif each.mode is not None:
                self._mark("role", each.mode, ("fixed", car), on_key=True)
                same = tuple(other for other, mode in self._fixed.items() if mode == each.mode)
                roles[each.mode] = Role(str(each.mode), each.mode, count=len(same), cars=same)
        self._check_stand_ins()
        rules = tuple(self._rule(index, each) for index, each in enumerate(entry.rules))
        phases = {name: self._phase(name, each) for name, each in entry.phases.items()}
        return Plan(
            MappingProxyType(roles),
            MappingProxyType(self._fixed),
            rules,
            MappingProxyType(phases),
            Mode.MANUAL if entry.without_role is WithoutRole.MANUAL else None,
            text,
            MappingProxyType(self._places),
        )

    def _role(self, name: str, entry: RoleEntry) -> Role:
        where: Where = ("roles", name)
        for index, capability in enumerate(entry.capabilities):
            if capability not in PARTS:
                self._report_unknown((*where, "capabilities", index), capability, sorted(PARTS), "capability")
        for index, platform in enumerate(entry.platforms or ()):
            try:
                profile = drivers.profile_of(platform)
            except ValueError as error:
                self._report((*where, "platforms", index), str(error))
                continue
            if entry.mode not in profile.modes:
                known = ", ".join(sorted(profile.modes))
                self._report(
                    (*where, "platforms", index), f"{platform} cars do not know mode {entry.mode}; they know {known}"
                )
        for index, car in enumerate(entry.cars or ()):
            self._check_car((*where, "cars", index), car)
            if self._fixed.get(car, name) != name:
                self._report((*where, "cars", index), f"`fixed` gives {car} only {self._fixed[car]}")
        if entry.if_none is not None:
            self._check_role((*where, "if_none"), entry.if_none)
        return Role(
            name,
            entry.mode,
            None if entry.needs is None else self._expression((*where, "needs"), entry.needs),
            None if entry.count == "all" else entry.count,
            entry.priority,
            None if entry.cars is None else tuple(dict.fromkeys(entry.cars)),
            frozenset(entry.capabilities),
            None if entry.platforms is None else tuple(entry.platforms),
            entry.if_none,
            entry.given_by is GivenBy.RULES,
        )

    def _check_stand_ins(self) -> None:
        for name in self._entry.roles:
            way = [name]
            while (after := self._stand_in(way[-1])) is not None and after not in way:
                way.append(after)
            if after == name:
                words = f"these roles stand in for each other: {' -> '.join([*way, name])}"
                self._report(("roles", name, "if_none"), words)

    def _stand_in(self, name: str) -> str | None:
        role = self._entry.roles.get(name)
        return None if role is None else role.if_none

    def _rule(self, index: int, entry: RuleEntry) -> Rule:
        where: Where = ("rules", index)
        several = isinstance(entry.then, list)
        effects = entry.then if isinstance(entry.then, list) else [entry.then]
        for place, phase in enumerate(entry.during or ()):
            self._check_phase((*where, "during", place), phase)
        if not effects:
            self._report((*where, "then"), "has no effect. Write one: `{who: this_car, role: rest}`", unless=where)
        self._mark("rule", entry.name or str(index + 1), where)
        return Rule(
            f"rule {entry.name or index + 1}",
            self._condition((*where, "when"), entry.when),
            tuple(
                self._effect((*where, "then", place) if several else (*where, "then"), each, entry.when)
                for place, each in enumerate(effects)
            ),
            None if entry.until is None else self._condition((*where, "until"), entry.until),
            None if entry.during is None else frozenset(entry.during),
        )

    def _effect(self, where: Where, entry: EffectEntry, when: Condition) -> Effect:
        actions = [name for name in ("role", "mode", "led") if getattr(entry, name) is not None]
        if entry.phase is not None:
            self._check_phase((*where, "phase"), entry.phase)
            if actions or entry.who is not None:
                self._report(where, "phase stands alone. Write `then: [{phase: …}, {who: …}]`")
        elif entry.who is None or not actions or {"role", "mode"} <= set(actions):
            self._report(where, "needs who and one of role, mode, led; or phase alone", unless=where)
        if entry.role is not None:
            self._check_role((*where, "role"), entry.role)
        if entry.who is not None and entry.who not in (*self._entry.roles, THIS_CAR, OTHER_CARS, ALL_CARS):
            self._check_car((*where, "who"), entry.who)
        if entry.role is not None and entry.who in self._entry.roles:
            self._report((*where, "who"), "a role takes no other role: name a car, this_car, other_cars or all_cars")
        if entry.who in (THIS_CAR, OTHER_CARS) and isinstance(when, ConditionEntry) and when.all_cars is not None:
            self._report((*where, "who"), f"with `all_cars` no single car made it true, so there is no {entry.who}")
        fixed = self._fixed.get(entry.who or "")
        if entry.role is not None and fixed not in (None, entry.role):
            self._report((*where, "role"), f"`fixed` gives {entry.who} only {fixed}")
        blink = entry.led if isinstance(entry.led, BlinkEntry) else None
        color = entry.led.color if isinstance(entry.led, BlinkEntry) else entry.led
        led = None if color is None else parse_color(color)
        return Effect(entry.who or "", entry.role, entry.mode, led, blink.blink_s if blink else None, entry.phase)

    def _phase(self, name: str, entry: PhaseEntry) -> PlanPhase:
        where: Where = ("phases", name)
        modes = {str(each.mode) for each in self._entry.fixed.values() if each.mode is not None}
        for index, role in enumerate(entry.roles or ()):
            self._check_role((*where, "roles", index), role, modes)
        for field in ("next", "on_timeout"):
            if (phase := getattr(entry, field)) is not None:
                self._check_phase((*where, field), phase)
        if entry.until is not None and entry.next is None:
            self._report((*where, "until"), "it needs next: the phase that begins then", unless=where)
        if entry.timeout_s is not None and entry.on_timeout is None and entry.next is None:
            words = "it needs on_timeout, or next: the phase that begins then"
            self._report((*where, "timeout_s"), words, unless=where)
        if entry.on_timeout is not None and entry.timeout_s is None:
            self._report((*where, "on_timeout"), "it needs timeout_s", unless=where)
        return PlanPhase(
            name,
            None if entry.roles is None else frozenset(entry.roles),
            None if entry.until is None else self._condition((*where, "until"), entry.until),
            entry.timeout_s,
            entry.next,
            entry.on_timeout if entry.on_timeout is not None else entry.next,
        )

    def _condition(self, where: Where, entry: Condition) -> PlanCondition:
        if isinstance(entry, str):
            return PlanCondition(Quantifier.ANY, self._expression(where, entry))
        quantifiers = [name for name in Quantifier if getattr(entry, name) is not None]
        if len(quantifiers) != 1:
            words = (
                "needs one of any_car, all_cars, car. Write: `{any_car: light.left}` or `{car: red, is: light.left}`"
            )
            self._report(where, words, unless=where)
        of = quantifiers[0] if quantifiers else Quantifier.ANY
        if of is Quantifier.CAR and entry.is_ is None:
            self._report(where, f"car needs `is`. Write: `{{car: {entry.car}, is: light.left}}`", unless=where)
        if of is not Quantifier.CAR and entry.is_ is not None:
            self._report((*where, "is"), f"stands only beside car. With {of} write the expression there")
        if entry.with_role is not None:
            if of is Quantifier.CAR:
                self._report((*where, "with_role"), "stands only beside any_car or all_cars")
            else:
                self._check_role((*where, "with_role"), entry.with_role)
        if entry.car is not None:
            self._check_car((*where, "car"), entry.car)
        place, text = ((*where, "is"), entry.is_) if of is Quantifier.CAR else ((*where, of.value), getattr(entry, of))
        return PlanCondition(of, self._expression(place, text or "false"), entry.car, entry.with_role, entry.for_s)

    def _expression(self, where: Where, text: str) -> Expression:
        try:
            return parse_expression(text, NAMES, ALIASES, FUNCTIONS)
        except BadExpression as error:
            self._report(where, error.words)
            return parse_expression("false", NAMES)

    def _mark(self, what: str, name: str, where: Where, *, on_key: bool = False) -> None:
        """Remember the position of a part for the lint's findings. For a car, the first position counts."""
        self._places.setdefault(f"{what} {name}", self._document.position(where, on_key=on_key))

    def _check_car(self, where: Where, name: str) -> None:
        self._mark("car", name, where)
        self._check_own_name(where, name)

    def _check_own_name(self, where: Where, name: str, *, on_key: bool = False) -> None:
        """Check a name that the user has chosen, of a car or of a part of the plan."""
        try:
            keys.check_name(name, "name")
        except keys.BadKey as error:
            self._report(where, str(error), on_key=on_key)
        if name in RESERVED:
            self._report(where, f"{name} is a word of rules ({', '.join(sorted(RESERVED))})", on_key=on_key)

    def _check_role(self, where: Where, name: str, others: Collection[str] = ()) -> None:
        if name not in self._entry.roles and name not in others and not self._is_faulty("roles", name):
            self._report_unknown(where, name, [*self._entry.roles, *others], "role")

    def _check_phase(self, where: Where, name: str) -> None:
        if name not in self._entry.phases and not self._is_faulty("phases", name):
            self._report_unknown(where, name, self._entry.phases, "phase")

    def _is_faulty(self, place: str, name: str) -> bool:
        """Return True if the entry of this name is faulty, or the section that may contain it."""
        return self._document.is_faulty((place,)) or self._document.is_faulty((place, name))

    def _report_unknown(self, where: Where, name: str, allowed: Iterable[str], what: str) -> None:
        names = list(allowed)
        self._report(where, f"there is no {what} {name}. {suggest(name, names)}")

    def _report(self, where: Where, words: str, *, on_key: bool = False, unless: Where | None = None) -> None:
        """Report a fault. Skip it if a field at `unless` is faulty, because it may only be a consequence of that."""
        if unless is None or not self._document.faulty_within(unless):
            self._document.report(where, words, on_key=on_key)
