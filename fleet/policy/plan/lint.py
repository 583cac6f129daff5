"""What can never work in a plan, before anything moves: roles that no car can fill, rules that never fire. Pure.

What is wrong in the text itself reader.py says. Here is what the plan means for the cars there are: those of a fleet
file, or (without one) cars of any platform.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from fleet.conditions.domains import outside
from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.plan.lint_conflicts import alternations, fights, implies
from fleet.policy.plan.plan import ALL, OTHERS, THAT, Effect, Plan, PlanPhase, Role, Rule
from fleet.policy.plan.reachability import ModeReachability, Outlook, seen, unmeasured
from fleet.policy.snapshot import NAMES, CarSnapshot
from gateway.protocol.enums import Mode
from schemas.yaml_document.messages import meant


class Severity(StrEnum):
    """How bad it is."""

    ERROR = "error"
    """It can never work."""
    WARNING = "warning"
    """It works, but hardly as it is meant."""


@dataclass(frozen=True, slots=True)
class PlanFault:
    """One thing that is wrong with a plan: of which part, what, and what to do."""

    gravity: Severity
    part: str
    words: str

    def __str__(self) -> str:
        return f"{self.part}: {self.words}"


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong with a plan; with an error it is not put in force."""

    errors: tuple[PlanFault, ...] = ()
    warnings: tuple[PlanFault, ...] = ()

    def refusal(self, source: str = "plan") -> str:
        """Every error, one a line, each with the plan's name; empty: the plan may be put in force."""
        return "\n".join(f"{source}: {each}" for each in self.errors)


def faults(plan: Plan, cars: Mapping[str, CarSnapshot] | None = None, there: Collection[str] | None = None) -> Faults:
    """What is wrong with a plan that is to be put in force.

    `cars`: those of the fleet file (hearing.listed_cars), None: there is none. Then a car that the plan names and that
    is not among those `there` (on the bus; None: not known) is a warning: it may still come.
    """
    found = check(plan, cars)
    warnings = [each for each in found if each.gravity is Severity.WARNING]
    if cars is None and there is not None:
        told = ", ".join(sorted(there)) or "no cars"
        warnings += [
            PlanFault(Severity.WARNING, f"car {car}", f"it is not on the bus now, which has {told}")
            for car in sorted(_named(plan) - set(there))
        ]
    return Faults(tuple(each for each in found if each.gravity is Severity.ERROR), tuple(warnings))


def _named(plan: Plan) -> set[str]:
    return set(plan.named) | {condition.car for condition in plan.conditions if condition.car is not None}


def check(plan: Plan, fleet: Mapping[str, CarSnapshot] | None = None) -> tuple[PlanFault, ...]:
    """What is wrong; `fleet`: what the fleet file says of its cars, None: there is none."""
    return tuple(_Check(plan, fleet).findings())


class _Check:
    def __init__(self, plan: Plan, fleet: Mapping[str, CarSnapshot] | None) -> None:
        self._plan = plan
        self._named = _named(plan)
        self._known = fleet
        self._reach = ModeReachability(plan, fleet, self._named)

    def findings(self) -> Iterator[PlanFault]:
        yield from self._unknown_cars()
        yield from self._unknown_roles()
        yield from self._roles()
        yield from self._rules()
        yield from self._phases()

    def _unknown_cars(self) -> Iterator[PlanFault]:
        for car in sorted(self._named):
            if self._known is not None and car not in self._known:
                there = ", ".join(sorted(self._known)) or "none"
                yield PlanFault(Severity.ERROR, f"car {car}", f"the fleet file has no such car; it has {there}")

    def _unknown_roles(self) -> Iterator[PlanFault]:
        for car, known in sorted((self._known or {}).items()):
            for role in sorted((known.roles or set()) - set(self._plan.roles)):
                there = f"there are {', '.join(self._plan.roles)}{meant(role, self._plan.roles)}"
                words = f"the fleet file lets it take role {role}, which this plan does not have: {there}"
                yield PlanFault(Severity.WARNING, f"car {car}", words)

    # ------------------------------------------------------------------ roles

    def _roles(self) -> Iterator[PlanFault]:
        for role in self._plan.roles.values():
            part = f"role {role.name}"
            if role.needs is not None and (why := outside(role.needs, NAMES)):
                yield PlanFault(Severity.ERROR, part, f"no car can fill it: {why}")
                continue
            able = [car for car in self._reach.cars if self._reach.able(car, role)]
            if not able:
                whys = "; ".join(f"{car}: {self._reach.why_not(car, role)}" for car in list(self._reach.cars)[:4])
                yield PlanFault(Severity.ERROR, part, f"no car can fill it{f': {whys}' if whys else ''}")
            elif (
                role.count is not None and len(able) < role.count and (self._known is not None or role.cars is not None)
            ):
                words = f"it wants {role.count} cars, and only {', '.join(sorted(able))} can have it"
                yield PlanFault(Severity.WARNING, part, words)
            if role.on_call and not self._called(role):
                yield PlanFault(
                    Severity.ERROR,
                    part,
                    "it is on_call, and no rule gives it to anyone, nor does it stand in for another",
                )
            if not role.on_call and not self._in_some_phase(role):
                yield PlanFault(Severity.WARNING, part, "no phase has it")

    def _called(self, role: Role) -> bool:
        given = any(effect.role == role.name for rule in self._plan.rules for effect in rule.effects)
        return given or any(other.fallback == role.name for other in self._plan.roles.values())

    def _in_some_phase(self, role: Role, during: frozenset[str] | None = None) -> bool:
        phases = [phase for phase in self._plan.phases.values() if during is None or phase.name in during]
        return not phases or any(phase.roles is None or role.name in phase.roles for phase in phases)

    # ------------------------------------------------------------------ rules

    def _rules(self) -> Iterator[PlanFault]:
        for rule in self._plan.rules:
            apart = [*self._out_of_phase(rule)]
            yield from apart
            for condition, word in ((rule.when, "fire"), (rule.until, "end by `until`")):
                outlook = Outlook() if condition is None or apart else self._reach.outlook(condition, rule.during)
                if outlook.never:
                    yield PlanFault(Severity.ERROR, rule.name, f"it can never {word}: {outlook.never}")
                elif outlook.only:
                    yield PlanFault(Severity.WARNING, rule.name, f"it can {word} only by {outlook.only}")
            if rule.until is not None and implies(rule.when, rule.until):
                words = f"it can never fire: {rule.until.text} ends it, and is so whenever it begins"
                yield PlanFault(Severity.ERROR, rule.name, words)
            for effect in rule.effects:
                yield from self._useless(rule, effect)
        yield from self._fights()
        yield from self._circular()

    def _out_of_phase(self, rule: Rule) -> Iterator[PlanFault]:
        """A rule about a role, or that gives one, which counts in none of the rule's phases."""
        for role in (rule.when.role, *(effect.role for effect in rule.effects)):
            if role is not None and not self._in_some_phase(self._plan.roles[role], rule.during):
                where = f"phase {' or '.join(sorted(rule.during))}" if rule.during is not None else "any phase"
                words = f"role {role} does not count in {where}"
                yield PlanFault(
                    Severity.ERROR, rule.name, f"it can never {'fire' if role == rule.when.role else 'help'}: {words}"
                )

    def _useless(self, rule: Rule, effect: Effect) -> Iterator[PlanFault]:
        """What no car that it is for can do."""
        who = effect.who if effect.who != THAT or rule.when.car is None else rule.when.car
        if who == OTHERS and self._known is not None and len(self._known) < 2:
            yield PlanFault(
                Severity.ERROR, rule.name, f"there are no others: the fleet file has {len(self._known)} car"
            )
        certain = bool(who) and self._plan.is_car(who)
        cars = [who] if certain else list(self._reach.cars)
        cars = [car for car in cars if car in self._reach.cars]
        if effect.role is not None:
            role = self._plan.roles[effect.role]
            whys = {car: self._reach.why_not(car, role) for car in cars}
            if certain and cars and all(whys.values()):
                yield PlanFault(Severity.ERROR, rule.name, f"{who} can never have role {role.name}: {whys[who]}")
        mode = effect.mode
        if mode is None or not cars or not all(self._cannot(car, mode) for car in cars):
            return
        words = f"{who} is {self._cannot(who, mode)}" if certain else f"no car can be in mode {mode}"
        yield PlanFault(Severity.ERROR, rule.name, words)

    def _cannot(self, car: str, mode: Mode) -> str:
        """Why it is never in this mode; empty if it can be."""
        profiles = self._reach.profiles(car)
        if not any(mode in profile.modes for profile in profiles):
            return f"a {profiles[0].name} car, which does not know mode {mode}"
        known = self._reach.cars[car]
        return f"not let do mode {mode} by the fleet file" if known.lacks(mode) else ""

    def _fights(self) -> Iterator[PlanFault]:
        for rule, words, always in fights(self._plan):
            yield PlanFault(Severity.ERROR if always else Severity.WARNING, rule.name, words)

    def _circular(self) -> Iterator[PlanFault]:
        """A rule that ends itself: in the mode that it gives, what makes it true is not measured."""
        for rule in self._plan.rules:
            if rule.until is not None:
                continue
            for effect in rule.effects:
                mode = effect.mode or (self._plan.roles[effect.role].mode if effect.role is not None else None)
                hits = (
                    effect.who == "that"
                    or effect.who == ALL
                    or (rule.when.car is not None and effect.who == rule.when.car)
                )
                if mode is None or not hits or effect.who == OTHERS:
                    continue
                cars = [car for car in self._reach.cars if rule.when.car in (None, car)]
                kinds = [profile for car in cars for profile in self._reach.profiles(car)]
                if kinds and not any(seen(rule.when.expression, profile, mode) for profile in kinds):
                    missing = ", ".join(unmeasured(rule.when.expression, kinds[0], mode))
                    words = f"it ends itself: in mode {mode}, {missing} is not measured; give it until"
                    yield PlanFault(Severity.WARNING, rule.name, words)

    # ------------------------------------------------------------------ phases

    def _phases(self) -> Iterator[PlanFault]:
        plan = self._plan
        reached = {plan.first}
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
                yield PlanFault(Severity.ERROR, part, f"nothing leads to it: the plan begins with {plan.first}")
            if phase.timeout_s is not None and phase.timeout_s < HYSTERESIS_S:
                words = f"it lasts {HYSTERESIS_S:g} s at least, whatever timeout_s says"
                yield PlanFault(Severity.WARNING, part, words)
            yield from self._endless(phase)
        for name, words in alternations(plan):
            yield PlanFault(Severity.ERROR, f"phase {name}", words)

    def _endless(self, phase: PlanPhase) -> Iterator[PlanFault]:
        """A phase that its condition does not end."""
        if phase.until is None:
            return
        outlook, jumps = self._reach.outlook(phase.until, {phase.name}), self._jumps_out(phase)
        why = self._no_role(phase) or outlook.never
        if phase.timeout_s is not None and phase.until.for_s >= phase.timeout_s:
            why = why or f"until wants {phase.until.for_s:g} s, and timeout_s is {phase.timeout_s:g}"
        part = f"phase {phase.name}"
        if why and phase.timeout_s is None and not jumps:
            yield PlanFault(Severity.ERROR, part, f"it never ends: {why}; or give it timeout_s")
        elif why:
            other = " or ".join([*(["its time-out"] if phase.timeout_s is not None else []), *jumps])
            yield PlanFault(Severity.WARNING, part, f"only {other} ends it: {why}")
        elif outlook.only:
            yield PlanFault(Severity.WARNING, part, f"it can end only by {outlook.only}")

    def _jumps_out(self, phase: PlanPhase) -> list[str]:
        """The rules that can end it."""
        return [
            rule.name
            for rule in self._plan.rules
            if any(effect.phase not in (None, phase.name) for effect in rule.effects)
            and (rule.during is None or phase.name in rule.during)
            and not self._reach.outlook(rule.when, {phase.name}).never
        ]

    def _no_role(self, phase: PlanPhase) -> str:
        role = None if phase.until is None else phase.until.role
        missing = role is not None and phase.roles is not None and role not in phase.roles
        return f"role {role} does not count in it" if missing else ""

    def _after(self, name: str) -> set[str]:
        phase = self._plan.phases.get(name)
        return set() if phase is None else {after for after in (phase.next, phase.on_timeout) if after is not None}
