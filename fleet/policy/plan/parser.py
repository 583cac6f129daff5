"""Parses a plan's text and reports all its faults at once, with line and column. Pure."""

from collections.abc import Collection, Iterable
from types import MappingProxyType
from typing import Final

from fleet.conditions import BadExpression, Expression
from fleet.conditions import parse as parse_expression
from fleet.policy.plan.models import ConditionEntry, EffectEntry, PhaseEntry, PlanEntry, RoleEntry, RuleEntry
from fleet.policy.plan.plan import (
    OTHERS,
    RESERVED,
    THAT,
    Effect,
    Plan,
    PlanCondition,
    PlanPhase,
    Quantifier,
    Role,
    Rule,
)
from fleet.policy.snapshot import NAMES
from gateway.protocol.enums import Mode
from gateway.protocol.platforms import OPTIONS, parse_platform
from schemas import keys
from schemas.yaml_document.document import BadFile, Document
from schemas.yaml_document.messages import Where, suggest

BadPlan = BadFile
"""Raised for a plan with faults; the text has one line for each, with file, line and column."""
CAPABILITIES: Final = frozenset(
    {*parse_platform("arduino").capabilities, *parse_platform("raspberry_pi").capabilities, *OPTIONS}
)
_MISSING: Final = {"mode": "manual", "when": {"any": "true"}, "then": []}
"""Values for missing required fields, so that the rest of a file can be checked."""


def parse(text: str, source: str = "plan") -> Plan:
    """Parse a plan; raises BadPlan with all faults. `source` is its name in errors, usually its path."""
    document = Document(text, source)
    entry = document.validate(PlanEntry) or document.validate_partial(PlanEntry, _MISSING)
    if entry is None:
        document.raise_faults()
    assert entry is not None  # else there was a problem
    plan = _PlanParser(document, entry).plan(text)
    document.raise_faults()
    return plan


class _PlanParser:
    """Makes a plan of the entries, and reports contradictions between them."""

    def __init__(self, document: Document, entry: PlanEntry) -> None:
        self._document = document
        self._entry = entry
        self._modes = tuple(Mode)

    def plan(self, text: str) -> Plan:
        entry = self._entry
        if not entry.cars and not entry.roles:
            words = "a plan has `cars:` or `roles:`, with one entry at least, as `cars: {red: tracking}`"
            self._report((), words, unless=())
        for place, names in (("roles", entry.roles), ("cars", entry.cars), ("phases", entry.phases)):
            for name in names:
                self._check_name((place, name), name, on_key=True)
                if name in RESERVED:
                    self._report(
                        (place, name), f"{name} is a word of rules ({', '.join(sorted(RESERVED))})", on_key=True
                    )
        for name in entry.roles:
            if name in entry.cars:
                self._report(("roles", name), "a car has this name: a rule could mean either", on_key=True)
            elif name in self._modes and any(role == name for role in entry.cars.values()):
                self._report(("roles", name), "a mode has this name, and `cars` uses it", on_key=True)
        roles = {name: self._role(name, each) for name, each in entry.roles.items()}
        for car, role in entry.cars.items():
            if role in entry.roles or (role not in self._modes and self._is_faulty("roles", role)):
                continue
            if role not in self._modes:
                self._report_unknown(("cars", car), role, [*entry.roles, *self._modes], "role or mode")
                continue
            same = tuple(other for other, each in entry.cars.items() if each == role)
            roles[role] = Role(role, Mode(role), count=len(same), cars=same)
        self._check_fallbacks()
        rules = tuple(self._rule(index, each) for index, each in enumerate(entry.rules))
        phases = {name: self._phase(name, each) for name, each in entry.phases.items()}
        self._check_circles()
        return Plan(
            MappingProxyType(roles),
            MappingProxyType(dict(entry.cars)),
            rules,
            MappingProxyType(phases),
            Mode.MANUAL if entry.idle == "manual" else None,
            text,
        )

    def _role(self, name: str, entry: RoleEntry) -> Role:
        where: Where = ("roles", name)
        for index, capability in enumerate(entry.capabilities):
            if capability not in CAPABILITIES:
                self._report_unknown((*where, "capabilities", index), capability, sorted(CAPABILITIES), "capability")
        for index, platform in enumerate(entry.platforms or ()):
            try:
                profile = parse_platform(platform)
            except ValueError as error:
                self._report((*where, "platforms", index), str(error))
                continue
            if entry.mode not in profile.modes:
                known = ", ".join(sorted(profile.modes))
                self._report(
                    (*where, "platforms", index), f"{platform} cars do not know mode {entry.mode}; they know {known}"
                )
        for index, car in enumerate(entry.cars or ()):
            self._check_name((*where, "cars", index), car)
            if car in self._entry.cars and self._entry.cars[car] != name:
                self._report((*where, "cars", index), f"{car} has only role {self._entry.cars[car]}, says `cars`")
        if entry.fallback is not None:
            self._check_role((*where, "fallback"), entry.fallback)
        return Role(
            name,
            entry.mode,
            None if entry.needs is None else self._expression((*where, "needs"), entry.needs),
            None if entry.count == "all" else entry.count,
            entry.priority,
            None if entry.cars is None else tuple(dict.fromkeys(entry.cars)),
            frozenset(entry.capabilities),
            None if entry.platforms is None else tuple(entry.platforms),
            entry.fallback,
            entry.on_call,
        )

    def _check_fallbacks(self) -> None:
        for name in self._entry.roles:
            way = [name]
            while (after := self._fallback(way[-1])) is not None and after not in way:
                way.append(after)
            if after == name:
                self._report(
                    ("roles", name, "fallback"), f"roles that stand in for each other: {' -> '.join([*way, name])}"
                )

    def _fallback(self, name: str) -> str | None:
        role = self._entry.roles.get(name)
        return None if role is None else role.fallback

    def _rule(self, index: int, entry: RuleEntry) -> Rule:
        where: Where = ("rules", index)
        several = isinstance(entry.then, list)
        effects = entry.then if isinstance(entry.then, list) else [entry.then]
        for place, phase in enumerate(entry.during or ()):
            self._check_phase((*where, "during", place), phase)
        return Rule(
            f"rule {entry.name}" if entry.name else f"rule {index + 1}",
            self._condition((*where, "when"), entry.when),
            tuple(
                self._effect((*where, "then", place) if several else (*where, "then"), each, entry.when)
                for place, each in enumerate(effects)
            ),
            None if entry.until is None else self._condition((*where, "until"), entry.until),
            None if entry.during is None else frozenset(entry.during),
        )

    def _effect(self, where: Where, entry: EffectEntry, when: ConditionEntry) -> Effect:
        actions = [name for name in ("role", "mode", "led") if getattr(entry, name) is not None]
        if entry.phase is not None:
            self._check_phase((*where, "phase"), entry.phase)
            if actions or entry.who is not None:
                self._report(where, "phase stands alone: give who and what an entry of its own in `then`")
        elif entry.who is None or not actions or {"role", "mode"} <= set(actions):
            self._report(where, "who with one of role and mode, or led, or both; or phase alone", unless=where)
        if entry.role is not None:
            self._check_role((*where, "role"), entry.role)
        if entry.who is not None and entry.who not in self._entry.roles:
            self._check_name((*where, "who"), entry.who)
        if entry.role is not None and entry.who in self._entry.roles:
            self._report((*where, "who"), "a role takes no other role: name cars, that, others or all")
        if entry.who in (THAT, OTHERS) and when.all is not None:
            self._report((*where, "who"), f"with `all` there is no car that made it true, so no {entry.who}")
        fixed = self._entry.cars.get(entry.who or "")
        if entry.role is not None and fixed not in (None, entry.role):
            self._report((*where, "role"), f"{entry.who} has only role {fixed}, says `cars`")
        return Effect(entry.who or "", entry.role, entry.mode, entry.led, entry.phase)

    def _phase(self, name: str, entry: PhaseEntry) -> PlanPhase:
        where: Where = ("phases", name)
        modes = {role for role in self._entry.cars.values() if role in self._modes}
        for index, role in enumerate(entry.roles or ()):
            self._check_role((*where, "roles", index), role, modes)
        for field in ("next", "on_timeout"):
            if (phase := getattr(entry, field)) is not None:
                self._check_phase((*where, field), phase)
        if entry.next is not None and entry.until is None and entry.timeout_s is None and not self._find_circle(name):
            self._report((*where, "next"), f"nothing ends {name}: give it until, or timeout_s", unless=where)
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

    def _find_circle(self, name: str) -> list[str]:
        """Return the way from a phase back to it through phases without an end; empty if there is none."""
        way = [name]
        while (entry := self._entry.phases.get(way[-1])) is not None:
            if entry.next is None or entry.until is not None or entry.timeout_s is not None:
                return []
            way.append(entry.next)
            if entry.next in way[:-1]:
                return way if entry.next == name else []
        return []

    def _check_circles(self) -> None:
        reported: set[str] = set()
        for name in self._entry.phases:
            way = self._find_circle(name)
            if way and name not in reported:
                reported |= set(way)
                circle = " -> ".join(way)
                words = f"a cycle of phases without a condition or a time-out: {circle}; give one until or timeout_s"
                self._report(("phases", name), words, unless=("phases", name))

    def _condition(self, where: Where, entry: ConditionEntry) -> PlanCondition:
        quantifiers = [name for name in Quantifier if getattr(entry, name) is not None]
        if len(quantifiers) != 1:
            words = f"exactly one of {', '.join(Quantifier)}, as `any: light.left` or `car: red` with `is: light.left`"
            self._report(where, words, unless=where)
        of = quantifiers[0] if quantifiers else Quantifier.ANY
        if of is Quantifier.CAR and entry.is_ is None:
            self._report(where, "car needs `is`: the expression that must be so of it", unless=where)
        if of is not Quantifier.CAR and entry.is_ is not None:
            self._report((*where, "is"), f"only with car; with {of} the expression stands there")
        if entry.role is not None:
            if of is Quantifier.CAR:
                self._report((*where, "role"), "only with any or all")
            else:
                self._check_role((*where, "role"), entry.role)
        if entry.car is not None:
            self._check_name((*where, "car"), entry.car)
        place, text = ((*where, "is"), entry.is_) if of is Quantifier.CAR else ((*where, of.value), getattr(entry, of))
        return PlanCondition(of, self._expression(place, text or "false"), entry.car, entry.role, entry.for_s)

    def _expression(self, where: Where, text: str) -> Expression:
        try:
            return parse_expression(text, NAMES)
        except BadExpression as error:
            self._report(where, str(error))
            return parse_expression("false", NAMES)

    def _check_name(self, where: Where, name: str, *, on_key: bool = False) -> None:
        try:
            keys.check_name(name, "name")
        except keys.BadKey as error:
            self._report(where, str(error), on_key=on_key)

    def _check_role(self, where: Where, name: str, others: Collection[str] = ()) -> None:
        if name not in self._entry.roles and name not in others and not self._is_faulty("roles", name):
            self._report_unknown(where, name, [*self._entry.roles, *others], "role")

    def _check_phase(self, where: Where, name: str) -> None:
        if name not in self._entry.phases and not self._is_faulty("phases", name):
            self._report_unknown(where, name, self._entry.phases, "phase")

    def _is_faulty(self, place: str, name: str) -> bool:
        """Return True if this name's entry, or the section that may contain it, is faulty."""
        return self._document.is_faulty((place,)) or self._document.is_faulty((place, name))

    def _report_unknown(self, where: Where, name: str, allowed: Iterable[str], what: str) -> None:
        names = list(allowed)
        listed = f"there are {', '.join(names)}" if names else "there is none"
        self._report(where, f"there is no {what} {name}: {listed}{suggest(name, names)}")

    def _report(self, where: Where, words: str, *, on_key: bool = False, unless: Where | None = None) -> None:
        """Report a fault. With `unless`, skip it if a field there is faulty, as it may only follow from that."""
        if unless is None or not self._document.faulty_within(unless):
            self._document.report(where, words, on_key=on_key)
