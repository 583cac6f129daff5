"""Snapshots of cars for the tests of policy/. Times are seconds of one clock."""

from typing import Any

from msgspec.structs import replace

from fleet.policy.decide import DecisionStep, step
from fleet.policy.plan.plan import Plan
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot, Refusal
from fleet.policy.state import PolicyState
from schemas import messages, topics
from schemas.messages import Observation

HERE = CarSnapshot(present=True, mode="manual", verdict="confirmed", link="online", motors="off", platform="arduino")
GONE = CarSnapshot()


def observed(topic: str, at: float, **fields: Any) -> Observation:
    return Observation(messages.message_class(topics.TOPICS[topic].message)(**fields), at)


def seen(at: float, **readings: dict[str, Any]) -> dict[str, Observation]:
    return {f"sensor/{name}": observed(f"sensor/{name}", at, **fields) for name, fields in readings.items()}


class PolicyRun:
    """A coordinator with given observations. If `obey`, its cars obey at once."""

    def __init__(self, plan: Plan, *cars: str, obey: bool = True) -> None:
        self.plan = plan
        self.memory = PolicyState()
        self.cars: dict[str, CarSnapshot] = dict.fromkeys(cars, HERE)
        self.readings: dict[str, dict[str, Observation]] = {}
        self.obey = obey
        self.asked: list[tuple[float, str, str]] = []
        self.now = 0.0
        self.last = DecisionStep(self.memory)

    def change(self, car: str, **fields: Any) -> None:
        self.cars[car] = replace(self.cars[car], **fields)

    def refuse(self, car: str, mode: str, reason: str) -> None:
        """Let the last command of a car have been refused."""
        self.cars[car] = self.cars[car].with_outcome(mode, Refusal(mode, reason, "", self.now))

    def sees(self, car: str, **topics: dict[str, Any]) -> None:
        self.readings[car] = {**self.readings.get(car, {}), **seen(self.now, **topics)}

    def at(self, now: float) -> DecisionStep:
        """Run one step at this time."""
        self.now = now
        self.last = step(self.plan, FleetSnapshot(dict(self.cars), dict(self.readings)), self.memory, now)
        self.memory = self.last.memory
        for command in self.last.commands:
            if command.mode is not None:
                self.asked.append((now, command.car, str(command.mode)))
                if self.obey:
                    self.change(command.car, mode=str(command.mode), verdict="assumed")
        return self.last

    def until(self, now: float, every: float = 0.1) -> DecisionStep:
        """Run steps up to this time. Return the last one."""
        while self.now + every <= now + 1e-9:
            self.at(round(self.now + every, 6))
        return self.last

    def of(self, subject: str) -> Any:
        return next(each for each in self.last.decisions if each.subject == subject)

    @property
    def roles(self) -> dict[str, str]:
        return dict(self.last.roles)
