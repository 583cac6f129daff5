"""Programs of cars that meet run in the order of their events, so that none sees another as it was or will be. Pure."""

from typing import Protocol


class Member(Protocol):
    """A car's program as its company drives it."""

    def due(self) -> float:
        """When it next runs by itself; inf if it will not."""
        ...

    def run_alone(self, now: float) -> None:
        """Run it up to `now`."""
        ...


class EventScheduler:
    """All the programs of one world in which cars meet."""

    def __init__(self) -> None:
        self._members: list[Member] = []

    def join(self, member: Member) -> None:
        """From now on this one runs with the others."""
        self._members.append(member)

    def run(self, now: float) -> None:
        """Run all up to `now`; of two events at one time that of the car that joined first."""
        if not self._members:
            return
        while (due := (first := min(self._members, key=_due)).due()) <= now:
            first.run_alone(due)
        for member in self._members:
            member.run_alone(now)


def _due(member: Member) -> float:
    return member.due()
