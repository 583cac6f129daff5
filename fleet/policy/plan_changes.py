"""Compares the roles, rules, phases and fixed cars of another plan with those of the plan in force. Pure."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from msgspec import Struct

from fleet.policy.plan.plan import Effect, Plan, PlanPhase, Role, Rule
from schemas.colors import hex_color

_ALL: Final = "all"


class PlanChange(Struct, frozen=True):
    """One part that differs, such as `role guide`, with its fields in both plans.

    `before` or `after` is empty if that plan lacks the part.
    """

    part: str
    before: tuple[tuple[str, str], ...] = ()
    after: tuple[tuple[str, str], ...] = ()

    @property
    def fields(self) -> tuple[tuple[str, str, str], ...]:
        """The fields that differ: name, before, after. A text is empty if the plan lacks the field."""
        then, now = dict(self.before), dict(self.after)
        names = dict.fromkeys((*then, *now))
        return tuple((name, then.get(name, ""), now.get(name, "")) for name in names if then.get(name) != now.get(name))


def plan_changes(before: Plan, after: Plan) -> tuple[PlanChange, ...]:
    """Return the parts that differ: roles, fixed cars, rules, phases, and what a car without a role does.

    The order of phases and of rules with names is not compared.
    """
    then, now = _parts(before), _parts(after)
    return tuple(
        PlanChange(part, then.get(part, ()), now.get(part, ()))
        for part in dict.fromkeys((*then, *now))
        if then.get(part) != now.get(part)
    )


_Fields = tuple[tuple[str, str], ...]


def _parts(plan: Plan) -> dict[str, _Fields]:
    """Return the fields of each part in words, by the part's name. Leave out fields that are not set."""
    parts: dict[str, dict[str, str]] = {f"role {name}": _role(role) for name, role in plan.roles.items()}
    parts |= {f"car {car}": {"role": role} for car, role in plan.fixed.items()}
    for number, rule in enumerate(plan.rules, 1):
        name = rule.name
        parts[name if name not in parts else f"{name} ({number})"] = _rule(rule)
    parts |= {f"phase {name}": _phase(phase) for name, phase in plan.phases.items()}
    parts["cars without a role"] = {"mode": "left alone" if plan.idle is None else str(plan.idle)}
    return {part: tuple((name, words) for name, words in fields.items() if words) for part, fields in parts.items()}


def _role(role: Role) -> dict[str, str]:
    return {
        "mode": str(role.mode),
        "count": _ALL if role.count is None else str(role.count),
        "needs": role.needs_text,
        "priority": str(role.priority or ""),
        "cars": _list(role.cars),
        "capabilities": _list(sorted(role.capabilities)),
        "platforms": _list(role.platforms),
        "if none": role.if_none or "",
        "given by": "rules" if role.by_rules else "",
    }


def _rule(rule: Rule) -> dict[str, str]:
    return {
        "when": rule.when.text,
        "until": "" if rule.until is None else rule.until.text,
        "then": "; ".join(map(_effect, rule.effects)),
        "during": _list(sorted(rule.during or ())),
    }


def _effect(effect: Effect) -> str:
    values: Mapping[str, Any] = {
        "role": effect.role,
        "mode": effect.mode,
        "LED": effect.led and hex_color(effect.led),
        "blinks each s": effect.blink_s,
        "phase": effect.phase,
    }
    words = [f"{name} {value}" for name, value in values.items() if value is not None]
    return " ".join([*([effect.who] if effect.who else []), ", ".join(words)])


def _phase(phase: PlanPhase) -> dict[str, str]:
    return {
        "roles": _ALL if phase.roles is None else _list(sorted(phase.roles)),
        "until": "" if phase.until is None else phase.until.text,
        "timeout": "" if phase.timeout_s is None else f"{phase.timeout_s:g} s",
        "next": phase.next or "",
        "on timeout": phase.on_timeout or "",
    }


def _list(names: Iterable[str] | None) -> str:
    return "" if names is None else ", ".join(names)
