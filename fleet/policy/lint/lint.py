"""Finds parts of a plan that can never work, before anything moves: roles without a car, dead rules. Pure.

plan_parser.py reports faults of the text itself. The lint checks the plan against the cars in a fleet file or, without
one, against cars of any platform.
"""

from collections.abc import Collection, Iterator, Mapping
from enum import StrEnum
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from fleet.conditions.satisfiability import explain_impossible
from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.lint.conflicts import find_conflicts, implies
from fleet.policy.lint.reachability import ModeReachability, Outlook, can_be_true, list_unmeasured
from fleet.policy.plan.plan import ALL_CARS, OTHER_CARS, THIS_CAR, Effect, Plan, PlanPhase, Role, Rule
from fleet.policy.snapshot import CarSnapshot, topic_of
from schemas.suggestion import misspelled
from schemas.words import Mode
from schemas.yaml_document.document import BadFile, Problem
from schemas.yaml_document.fault_words import suggest

_WORDS_FOR_CARS: Final = (THIS_CAR, OTHER_CARS, ALL_CARS)


class Severity(StrEnum):
    """The severity of a fault."""

    ERROR = "error"
    """This part of the plan can never work."""
    WARNING = "warning"
    """This part of the plan works, but probably not as intended."""


class PlanFault(Struct, frozen=True):
    """One fault of a plan: the part, what is wrong with it, and what to do. line, column: position of the part."""

    severity: Severity
    part: str
    words: str
    line: int = 1
    column: int = 1

    def __str__(self) -> str:
        return f"{self.part}: {self.words}"

    def at(self, source: str) -> str:
        """Return the fault as a line for a person, as `plan.yaml:4:3: error: rule 2: it never fires`."""
        return f"{source}:{self.line}:{self.column}: {self.severity}: {self}"


class Faults(Struct, frozen=True):
    """The faults of a plan. The coordinator refuses a plan with errors."""

    errors: tuple[PlanFault, ...] = ()
    warnings: tuple[PlanFault, ...] = ()

    def refusal(self, source: str = "plan") -> str:
        """Return all errors, one per line. If the text is empty, the plan may be put in force.

        `source` is the name or path of the plan.
        """
        return "\n".join(each.at(source) for each in self.errors)

    def raise_errors(self, source: str) -> None:
        """Raise BadFile with all errors, if there are any."""
        if self.errors:
            raise BadFile(source, [Problem(each.line, each.column, each.part, each.words) for each in self.errors])


def find_faults(
    plan: Plan, cars: Mapping[str, CarSnapshot] | None = None, present: Collection[str] | None = None
) -> Faults:
    """Return the faults of a plan before it is put in force.

    `cars` has the cars in the fleet file (observer.listed_cars), or is None if there is no fleet file. `present` are
    the cars on the bus, or None if they are not known. Without a fleet file, a car of the plan that is not present is
    only a warning and no error, because it may still come.
    """
    findings = check(plan, cars)
    reported = {each.part for each in findings}
    warnings = [each for each in findings if each.severity is Severity.WARNING]
    if cars is None and present is not None:
        listed = ", ".join(sorted(present)) or "no cars"
        warnings += [
            _with_place(
                plan, PlanFault(Severity.WARNING, f"car {car}", f"it is not connected now. Connected: {listed}.")
            )
            for car in sorted(_cars_named_in(plan) - set(present))
            if f"car {car}" not in reported
        ]
        warnings.sort(key=_position)
    return Faults(tuple(each for each in findings if each.severity is Severity.ERROR), tuple(warnings))


def _cars_named_in(plan: Plan) -> set[str]:
    return set(plan.named_cars) | {condition.car for condition in plan.conditions if condition.car is not None}


def check(plan: Plan, fleet: Mapping[str, CarSnapshot] | None = None) -> tuple[PlanFault, ...]:
    """Return the faults of a plan by line. `fleet` has the cars in the fleet file, or is None if there is no file."""
    found = dict.fromkeys(_with_place(plan, fault) for fault in _Check(plan, fleet).findings())
    return tuple(sorted(found, key=_position))


def _position(fault: PlanFault) -> tuple[int, int]:
    return fault.line, fault.column


def _with_place(plan: Plan, fault: PlanFault) -> PlanFault:
    line, column = plan.places.get(fault.part, (1, 1))
    return replace(fault, line=line, column=column)


class _Check:
    def __init__(self, plan: Plan, fleet: Mapping[str, CarSnapshot] | None) -> None:
        self._plan = plan
        self._named = _cars_named_in(plan)
        self._known = fleet
        self._unknown = set() if fleet is None else self._named - set(fleet)
        """Cars of the plan that are not in the fleet file. They are reported once, and not for each part that names
        them."""
        self._reach = ModeReachability(plan, fleet, self._named)

    def findings(self) -> Iterator[PlanFault]:
        yield from self._unknown_cars()
        yield from self._unknown_roles()
        yield from self._roles()
        yield from self._rules()
        yield from self._phases()

    def _unknown_cars(self) -> Iterator[PlanFault]:
        targets = {effect.who for rule in self._plan.rules for effect in rule.effects}
        for car in sorted(self._named):
            if self._known is not None and car in self._unknown:
                words = [*_WORDS_FOR_CARS, *sorted(self._known)] if car in targets else sorted(self._known)
                yield PlanFault(Severity.ERROR, f"car {car}", f"the fleet file has no such car. {suggest(car, words)}")
            elif self._known is None and car in targets:
                for word in misspelled(car, _WORDS_FOR_CARS)[:1]:
                    wrong = f"it seems to be misspelled. Did you mean {word}?"
                    yield PlanFault(Severity.ERROR, f"car {car}", wrong)

    def _unknown_roles(self) -> Iterator[PlanFault]:
        for car, known in sorted((self._known or {}).items()):
            for role in sorted((known.roles or set()) - set(self._plan.roles)):
                words = f"the fleet file lets it take role {role}, which this plan does not have."
                words = f"{words} {suggest(role, self._plan.roles)}"
                yield PlanFault(Severity.WARNING, f"car {car}", words)

    # ------------------------------------------------------------------ roles

    def _roles(self) -> Iterator[PlanFault]:
        for role in self._plan.roles.values():
            part = f"role {role.name}"
            if role.needs is not None and (why := explain_impossible(role.needs)):
                yield PlanFault(Severity.ERROR, part, f"no car can fill it: {why}")
                continue
            can_have = [car for car in self._reach.cars if self._reach.can_have(car, role)]
            unknown = self._unknown.intersection(role.cars or ())
            if not can_have and not unknown:
                whys = "; ".join(
                    f"{car}: {self._reach.explain_barrier(car, role)}" for car in list(self._reach.cars)[:4]
                )
                yield PlanFault(Severity.ERROR, part, f"no car can fill it{f': {whys}' if whys else ''}")
            elif (
                role.count is not None
                and len(can_have) + len(unknown) < role.count
                and (self._known is not None or role.cars is not None)
            ):
                words = f"it wants {role.count} cars, and only {', '.join(sorted(can_have))} can have it"
                yield PlanFault(Severity.WARNING, part, words)
            if can_have and (why := self._reach.explain_blindness(role)):
                yield PlanFault(Severity.WARNING, part, f"it may never get a car: {why}")
            if role.by_rules and not self._is_called(role):
                yield PlanFault(
                    Severity.ERROR,
                    part,
                    "no rule gives it to a car, and it says `given_by: rules`",
                )
            if not role.by_rules and not self._in_some_phase(role):
                yield PlanFault(Severity.WARNING, part, "no phase has it")

    def _is_called(self, role: Role) -> bool:
        is_given = any(effect.role == role.name for rule in self._plan.rules for effect in rule.effects)
        return is_given or any(other.if_none == role.name for other in self._plan.roles.values())

    def _in_some_phase(self, role: Role, during: frozenset[str] | None = None) -> bool:
        phases = [phase for phase in self._plan.phases.values() if during is None or phase.name in during]
        return not phases or any(phase.roles is None or role.name in phase.roles for phase in phases)

    # ------------------------------------------------------------------ rules

    def _rules(self) -> Iterator[PlanFault]:
        for rule in self._plan.rules:
            out_of_phase = [*self._out_of_phase(rule)]
            yield from out_of_phase
            for condition, word in ((rule.when, "fires"), (rule.until, "ends by `until`")):
                skip = condition is None or out_of_phase or condition.car in self._unknown
                outlook = Outlook() if skip or condition is None else self._reach.assess(condition, rule.during)
                if outlook.never:
                    yield PlanFault(Severity.ERROR, rule.name, f"it never {word}. {outlook.never}")
                elif outlook.only_when:
                    yield PlanFault(Severity.WARNING, rule.name, f"it {word} only when {outlook.only_when}")
                elif condition is rule.when and (words := self._blind(rule)):
                    yield PlanFault(Severity.WARNING, rule.name, words)
            if rule.until is not None and implies(rule.when, rule.until):
                words = f"it never fires. Its `until` ({rule.until.text}) is true whenever it begins."
                yield PlanFault(Severity.ERROR, rule.name, words)
            for effect in rule.effects:
                yield from self._useless(rule, effect)
        yield from self._conflicts()
        yield from self._self_ending()

    def _blind(self, rule: Rule) -> str:
        """Describe the cars that a rule never sees, because they do not measure its readings in their role's mode."""
        when = rule.when
        topics = {topic_of(name) for name in when.expression.names}
        for role in self._plan.roles.values():
            about = when.car is None and when.role in (None, role.name) and self._in_some_phase(role, rule.during)
            # A rule about a role's needs is meant for cars that do not meet them, and so do not have the role.
            needed = role.needs is not None and topics & {topic_of(name) for name in role.needs.names}
            kinds = [
                kind
                for car in self._reach.cars
                if self._reach.can_have(car, role)
                for kind in self._reach.profiles(car)
            ]
            if not about or needed or role.by_rules or not kinds:
                continue
            if not any(can_be_true(when.expression, kind, role.mode) for kind in kinds):
                missing = ", ".join(list_unmeasured(when.expression, kinds[0], role.mode))
                return f"it never sees cars with role {role.name}: in {role.mode} they do not measure {missing}."
        return ""

    def _out_of_phase(self, rule: Rule) -> Iterator[PlanFault]:
        """Report a rule that is about a role, or gives one, if that role counts in none of the rule's phases."""
        for role in (rule.when.role, *(effect.role for effect in rule.effects)):
            if role is not None and not self._in_some_phase(self._plan.roles[role], rule.during):
                where = f"phase {' or '.join(sorted(rule.during))}" if rule.during is not None else "any phase"
                words = f"it {'never fires' if role == rule.when.role else 'has no effect'}."
                yield PlanFault(Severity.ERROR, rule.name, f"{words} Role {role} does not count in {where}.")

    def _useless(self, rule: Rule, effect: Effect) -> Iterator[PlanFault]:
        """Report an effect that none of its cars can follow."""
        who = effect.who if effect.who != THIS_CAR or rule.when.car is None else rule.when.car
        if who == OTHER_CARS and self._known is not None and len(self._known) < 2:
            yield PlanFault(
                Severity.ERROR, rule.name, f"there are no others: the fleet file has {len(self._known)} car"
            )
        certain = bool(who) and self._plan.is_car(who)
        cars = [who] if certain else list(self._reach.cars)
        cars = [car for car in cars if car in self._reach.cars]
        if effect.role is not None:
            role = self._plan.roles[effect.role]
            whys = {car: self._reach.explain_barrier(car, role) for car in cars}
            if certain and cars and all(whys.values()):
                yield PlanFault(Severity.ERROR, rule.name, f"{who} can never have role {role.name}: {whys[who]}")
        if effect.led is not None and cars and all(self._reach.cars[car].lacks_led for car in cars):
            words = f"{who} has no color LED" if certain else "no car has a color LED"
            yield PlanFault(Severity.WARNING, rule.name, f"its color is never seen: {words}")
        mode = effect.mode
        if mode is None or not cars or not all(self._cannot(car, mode) for car in cars):
            return
        words = f"{who} is {self._cannot(who, mode)}" if certain else f"no car can be in mode {mode}"
        yield PlanFault(Severity.ERROR, rule.name, words)

    def _cannot(self, car: str, mode: Mode) -> str:
        """Return the reason why a car is never in this mode, or an empty text if it can be."""
        profiles = self._reach.profiles(car)
        if not any(mode in profile.modes for profile in profiles):
            return f"a {profiles[0].name} car, which does not know mode {mode}"
        known = self._reach.cars[car]
        return f"not allowed in mode {mode} by the fleet file" if known.lacks(mode) else ""

    def _conflicts(self) -> Iterator[PlanFault]:
        for rule, words, always in find_conflicts(self._plan):
            yield PlanFault(Severity.ERROR if always else Severity.WARNING, rule.name, words)

    def _self_ending(self) -> Iterator[PlanFault]:
        """Report a rule that ends itself, because cars do not measure its readings in the mode that it gives them."""
        for rule in self._plan.rules:
            if rule.until is not None:
                continue
            for effect in rule.effects:
                mode = effect.mode or (self._plan.roles[effect.role].mode if effect.role is not None else None)
                hits = (
                    effect.who == THIS_CAR
                    or effect.who == ALL_CARS
                    or (rule.when.car is not None and effect.who == rule.when.car)
                )
                if mode is None or not hits or effect.who == OTHER_CARS:
                    continue
                cars = [car for car in self._reach.cars if rule.when.car in (None, car)]
                kinds = [profile for car in cars for profile in self._reach.profiles(car)]
                if kinds and not any(can_be_true(rule.when.expression, profile, mode) for profile in kinds):
                    missing = ", ".join(list_unmeasured(rule.when.expression, kinds[0], mode))
                    words = f"it ends itself. In mode {mode} a car does not measure {missing}. Add `until`."
                    yield PlanFault(Severity.WARNING, rule.name, words)

    # ------------------------------------------------------------------ phases

    def _phases(self) -> Iterator[PlanFault]:
        plan = self._plan
        reached = {plan.first_phase}
        jumps = [
            (rule.during, effect.phase) for rule in plan.rules for effect in rule.effects if effect.phase is not None
        ]
        while True:
            more = {after for name in reached for after in self._after(name)}
            more |= {phase for during, phase in jumps if during is None or during & reached}
            if more <= reached:
                break
            reached |= more
        for name, phase in plan.phases.items():
            part = f"phase {name}"
            if name not in reached:
                yield PlanFault(Severity.ERROR, part, f"nothing leads to it: the plan begins with {plan.first_phase}")
            if phase.timeout_s is not None and phase.timeout_s < HYSTERESIS_S:
                words = f"it lasts {HYSTERESIS_S:g} s at least, whatever timeout_s says"
                yield PlanFault(Severity.WARNING, part, words)
            yield from self._endless(phase)

    def _endless(self, phase: PlanPhase) -> Iterator[PlanFault]:
        """Report a phase that does not end by its condition."""
        if phase.until is None:
            if phase.next is not None and phase.timeout_s is None and not self._jumps_out(phase):
                words = "only `fleet plan next` ends it: it has neither until nor timeout_s."
                yield PlanFault(Severity.WARNING, f"phase {phase.name}", words)
            return
        if phase.until.car in self._unknown:
            return
        outlook, jumps = self._reach.assess(phase.until, {phase.name}), self._jumps_out(phase)
        why = self._no_role(phase) or outlook.never
        if phase.timeout_s is not None and phase.until.for_s >= phase.timeout_s:
            why = why or f"Its `until` takes {phase.until.for_s:g} s, and timeout_s is {phase.timeout_s:g}."
        part = f"phase {phase.name}"
        if why and phase.timeout_s is None and not jumps:
            yield PlanFault(Severity.ERROR, part, f"it never ends. {why} Or add timeout_s.")
        elif why:
            other = " or ".join([*(["its timeout"] if phase.timeout_s is not None else []), *jumps])
            yield PlanFault(Severity.WARNING, part, f"only {other} ends it. {why}")
        elif outlook.only_when:
            yield PlanFault(Severity.WARNING, part, f"it ends only when {outlook.only_when}")

    def _jumps_out(self, phase: PlanPhase) -> list[str]:
        """List the rules that can end a phase."""
        return [
            rule.name
            for rule in self._plan.rules
            if any(effect.phase not in (None, phase.name) for effect in rule.effects)
            and (rule.during is None or phase.name in rule.during)
            and not self._reach.assess(rule.when, {phase.name}).never
        ]

    def _no_role(self, phase: PlanPhase) -> str:
        role = None if phase.until is None else phase.until.role
        missing = role is not None and phase.roles is not None and role not in phase.roles
        return f"Role {role} does not count in it." if missing else ""

    def _after(self, name: str) -> set[str]:
        phase = self._plan.phases.get(name)
        return set() if phase is None else {after for after in (phase.next, phase.on_timeout) if after is not None}
