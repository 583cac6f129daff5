"""Output of the coordinator to the bus: plan, roles, decisions and a log. Queries get the last messages."""

import contextlib
import time
import traceback
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import zenoh
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.client.client import Fleet
from fleet.policy.decide import DecisionStep
from fleet.policy.decision import LEFT_ALONE, Decision
from fleet.policy.plan.plan import Plan
from fleet.policy.state import PolicyState
from schemas import keys, messages, topics
from schemas.bus import Publisher, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Level

REPUBLISH_INTERVAL_S: Final = 10.0
"""Interval at which plan, assignment and decisions are published again, for recordings that began later."""
INTERNAL_ERROR: Final = "internal_error"
"""Code of the event about an unexpected exception. The coordinator keeps running."""
_MAX_ERROR_LENGTH: Final = 500
"""Maximum characters of such an exception's text, which may quote payloads from the bus."""


class Publications:
    """The publications of one coordinator."""

    def __init__(self, client: Fleet, on_failure: Callable[[str], None]) -> None:
        self._client = client
        self._on_failure = on_failure
        self._last: dict[tuple[str, str], tuple[Publisher, Any]] = {}
        """The last message by topic and subject, for replies to queries."""
        self._publishers: dict[str, Publisher] = {}
        self._republish_at = time.monotonic() + REPUBLISH_INTERVAL_S
        self._internal_errors: dict[str, float] = {}
        """Time at which each unexpected exception was logged last, by its words."""

    def publish(self, name: str, message: Any) -> None:
        """Publish a message of the topic `@coordinator/<name>`, and keep it for queries."""
        publisher = self._publisher(name)
        self._last[name, getattr(message, "subject", "")] = (publisher, message)
        publisher.put(message, time.time_ns())

    def republish(self, now: float) -> None:
        """Publish everything again if it is time to."""
        if now >= self._republish_at:
            self._republish_at = now + REPUBLISH_INTERVAL_S
            for publisher, message in self._last.values():
                publisher.put(message, time.time_ns())

    def forget(self, subjects: Collection[str] | None = None) -> None:
        """Forget the decisions about these subjects, or all decisions if `subjects` is None."""
        for name, subject in [*self._last]:
            if name == "decision" and (subjects is None or subject in subjects):
                del self._last[name, subject]

    def reply(self, query: zenoh.Query) -> None:
        """Answer a query with the last messages of its keys."""
        for publisher, message in self._last.values():
            if query.key_expr.intersects(publisher.key):
                reply_value(query, publisher.key, message.SerializeToString(), publisher.topic)

    def log(self, level: Level, code: str, words: str) -> None:
        """Publish an event as foxglove.Log."""
        now_ns = time.time_ns()
        name = f"{keys.COORDINATOR} {code}"
        self._publisher("log").put(messages.log_message(now_ns, level, name, words), now_ns)

    def log_internal_error(self, during: str, error: Exception) -> str:
        """Log an unexpected exception as an event and on stderr. Return its text.

        The same text is logged only once per REPUBLISH_INTERVAL_S, because a fault in each step would fill the disk.
        """
        frames = traceback.extract_tb(error.__traceback__)
        where = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
        words = f"{INTERNAL_ERROR} while {during}: {type(error).__name__}{where}: {str(error)[:_MAX_ERROR_LENGTH]}"
        now = time.monotonic()
        self._internal_errors = {
            each: at for each, at in self._internal_errors.items() if now - at < REPUBLISH_INTERVAL_S
        }
        if words not in self._internal_errors:
            self._internal_errors[words] = now
            self.log(Level.ERROR, INTERNAL_ERROR, words)
            with contextlib.suppress(Exception):  # the error may come from `on_failure` itself
                self._on_failure(words)
        return words

    def _publisher(self, name: str) -> Publisher:
        topic = topics.TOPICS[f"{keys.COORDINATOR}/{name}"]
        if name not in self._publishers:
            key = f"{self._client.name}/{topic.name}"
            self._publishers[name] = self._client.bus.publisher(key, topic, keys.COORDINATOR)
        return self._publishers[name]


def decision_message(decision: Decision, since_s: float) -> pb.Decision:
    """Return the message of a decision that has held since `since_s`, s of the wall clock."""
    return pb.Decision(
        since=Timestamp(seconds=int(since_s), nanos=int(since_s % 1 * 1e9)),
        subject=decision.subject,
        decided=decision.decided,
        why=decision.why,
        readings=decision.readings,
        would_change=decision.would_change,
        kind=decision.kind,
        role=decision.role or "",
    )


def in_force(memory: PolicyState) -> tuple[str, list[int]]:
    """Return the phase and the rules in force."""
    return memory.phase.name, sorted(index for index, state in memory.rules.items() if state.on)


def assignment_message(plan: Plan, result: DecisionStep) -> pb.Assignment:
    """Return the message of the roles, the phase and the rules in force."""
    roles: dict[str, list[str]] = {}
    for car, role in sorted(result.roles.items()):
        roles.setdefault(role, []).append(car)
    for decision in result.decisions:
        if decision.car is not None and decision.car not in result.roles:
            roles.setdefault(decision.mode or LEFT_ALONE, []).append(decision.car)
    return pb.Assignment(
        roles=[pb.Role(name=name, cars=cars) for name, cars in sorted(roles.items())],
        phase=result.memory.phase.name,
        plan_version=plan.version,
        rules=[plan.rules[index].name for index in in_force(result.memory)[1]],
        stopped_by=result.memory.stopped_by,
    )
