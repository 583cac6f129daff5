"""The content of the plan page: the plan in force, the role of each car, and the reasons. Pure."""

from typing import Any

from schemas import keys, messages
from schemas.words import Level


class PlanView:
    """The newest messages of the coordinator."""

    def __init__(self) -> None:
        self.changed = True
        """True if there is something that the pages do not show yet."""
        self._running = False
        self._plan: Any = None
        self._assignment: Any = None
        self._decisions: dict[str, Any] = {}
        self._log: list[dict[str, Any]] = []

    def on_message(self, topic: str, value: Any) -> None:
        """Handle a message of the coordinator. topic: such as `@coordinator/plan`."""
        match topic:
            case "@coordinator/plan":
                if self._plan is not None and value.boot_id != self._plan.boot_id:
                    self._decisions.clear()  # of the coordinator before
                self._plan = value
            case "@coordinator/assignment":
                self._assignment = value
            case "@coordinator/decision":
                self._decisions[value.subject] = value
            case _:  # the log
                at_ms = value.timestamp.seconds * 1000
                is_bad = messages.level_of(value) in (Level.WARNING, Level.ERROR)
                self._log = [{"at_ms": at_ms, "words": value.message, "bad": is_bad}, *self._log[:9]]
        self.changed = True

    def on_presence(self, *, running: bool) -> None:
        """Handle that the coordinator is on the bus, or not."""
        self.changed = self.changed or running is not self._running
        self._running = running

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        plan, assignment = self._plan, self._assignment
        shown: dict[str, Any] = {"running": self._running, "plan": None, "log": self._log}
        if plan is None:
            return shown
        shown["plan"] = {"text": plan.text, "version": plan.version, "set_by": plan.set_by}
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


def coordinator_topic(key: str, fleet: str) -> str:
    """Return the topic of a key of the coordinator, such as `@coordinator/plan`. Empty for other keys."""
    name, _, topic = key.partition("/")
    return topic if name == fleet and topic.startswith(f"{keys.COORDINATOR}/") else ""
