"""The content of the plan page: the plan in force, the role of each car, and the reasons. Pure."""

from collections.abc import Iterable
from typing import Any, Final

from fleet.policy.decision import LEFT_ALONE
from fleet.policy.plan.plan import version_of
from schemas import keys, messages
from schemas.words import Level

MAX_PLAN_NAME_LENGTH: Final = 80
"""Maximum length of the name of a plan, so that it fits on one line of a large screen."""


class PlanView:
    """The newest messages of the coordinator."""

    def __init__(self) -> None:
        self.changed = True
        """True if something has changed that the pages do not show yet."""
        self._running = False
        self._plan: Any = None
        self._assignment: Any = None
        self._decisions: dict[str, Any] = {}
        self._log: list[dict[str, Any]] = []

    def on_message(self, topic: str, value: Any) -> None:
        """Handle a message of the coordinator, on a topic such as `@coordinator/plan`."""
        match topic:
            case "@coordinator/plan":
                if self._plan is not None and value.boot_id != self._plan.boot_id:
                    self._decisions.clear()  # they are of an earlier coordinator
                self._plan = value
            case "@coordinator/assignment":
                self._assignment = value
            case "@coordinator/decision":
                self._decisions[value.subject] = value
            case _:  # the log
                at_ms, words = value.timestamp.seconds * 1000, value.message
                if self._plan is not None:
                    words = named(words, self._plan.text)
                is_bad = messages.level_of(value) in (Level.WARNING, Level.ERROR)
                self._log = [{"at_ms": at_ms, "words": words, "bad": is_bad}, *self._log[:9]]
        self.changed = True

    @property
    def in_force(self) -> tuple[str, dict[str, str], str]:
        """The text of the running plan (empty if there is none), the role of each car, and the phase."""
        if self._plan is None or not self._running:
            return "", {}, ""
        if self._assignment is None:
            return self._plan.text, {}, ""
        roles = {car: role.name for role in self._assignment.roles for car in role.cars}
        return self._plan.text, roles, self._assignment.phase

    def on_presence(self, *, running: bool) -> None:
        """Note whether the coordinator is on the bus."""
        self.changed = self.changed or running is not self._running
        self._running = running

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the page as JSON values."""
        plan, assignment = self._plan, self._assignment
        shown: dict[str, Any] = {"running": self._running, "plan": None, "log": self._log}
        if plan is None:
            return shown
        roles = [] if assignment is None else [role.name for role in assignment.roles if role.name != LEFT_ALONE]
        shown["plan"] = {"text": plan.text, "name": plan_name(plan.text, roles), "set_by": plan.set_by}
        if assignment is not None:
            shown["roles"] = [{"name": role.name, "cars": list(role.cars)} for role in assignment.roles]
            shown |= {"phase": assignment.phase, "rules": list(assignment.rules), "stopped_by": assignment.stopped_by}
        shown["decisions"] = [
            {
                "subject": each.subject,
                "decided": each.decided,
                "why": each.why,
                "readings": list(each.readings),
                "would_change": each.would_change.split("; or ") if each.would_change else [],
                "since": each.since.seconds,
            }
            for _, each in sorted(self._decisions.items())
        ]
        return shown


def plan_name(text: str, roles: Iterable[str]) -> str:
    """Return a name of the plan for persons: the comment at its beginning, or else its roles. It is never the hash."""
    for line in text.splitlines():
        words = line.strip()
        if words and not words.startswith("#"):
            break
        if (words := words.lstrip("# ")) and not words.startswith("yaml-language-server"):
            return words[:MAX_PLAN_NAME_LENGTH].rstrip(". ")
    return ", ".join(roles)[:MAX_PLAN_NAME_LENGTH] or "without a name"


def named(words: str, text: str) -> str:
    """Replace the hash of a plan by its name in words of a coordinator. `text` is the text of the plan."""
    return words.replace(f"plan {version_of(text)}", f"plan “{plan_name(text, ())}”")


def coordinator_topic(key: str, fleet: str) -> str:
    """Return the topic of a key of the coordinator, such as `@coordinator/plan`. Empty for other keys."""
    name, _, topic = key.partition("/")
    return topic if name == fleet and topic.startswith(f"{keys.COORDINATOR}/") else ""
