"""Runs the programs of cars that meet in the order of their events, so that all see the same moment. Pure."""

from typing import Protocol


class Member(Protocol):
    """A car's program."""

    def due(self) -> float:
        """Return the time at which the program next runs; inf if it never does."""

    def run_alone(self, now: float) -> None:
        """Run this program up to `now`."""


class EventScheduler:
    """All programs of one world in which cars meet."""

    def __init__(self) -> None:
        self._members: list[Member] = []

    def join(self, member: Member) -> None:
        """Add a program."""
        self._members.append(member)

    def run(self, now: float) -> None:
        """Run all programs up to `now`. Of two simultaneous events, that of the earlier member runs first."""
        if not self._members:
            return
        while (due := (first := min(self._members, key=_due)).due()) <= now:
            first.run_alone(due)
        for member in self._members:
            member.run_alone(now)


def _due(member: Member) -> float:
    return member.due()
