"""Runs the programs of cars that affect each other, event by event in the order of time. Pure.

In this order, no program is ahead of another one when it reads its sensors.
"""

from typing import Protocol


class Member(Protocol):
    """A car's program."""

    def due(self) -> float:
        """Return the time at which the program runs next, or inf if it never runs again."""

    def run_alone(self, now: float) -> None:
        """Run this program up to `now`."""


class EventScheduler:
    """All programs of one lively world (see `World.lively`)."""

    def __init__(self) -> None:
        self._members: list[Member] = []

    def join(self, member: Member) -> None:
        """Add a program."""
        self._members.append(member)

    def run(self, now: float) -> None:
        """Run all programs up to `now`. If two events are simultaneous, the program that joined first runs first."""
        while self._members:
            next_member = min(self._members, key=_due)
            due = next_member.due()
            if due > now:
                break
            next_member.run_alone(due)
        for member in self._members:
            member.run_alone(now)


def _due(member: Member) -> float:
    return member.due()
