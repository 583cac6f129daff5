"""A measured cost and the floor under it; five runs of each, in turns, so that both see the same machine."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

RUNS = 5

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Measured:
    """One line of the table; `ours` and `floor` have one value per run."""

    name: str
    ours: tuple[float, ...]
    floor: tuple[float, ...]
    unit: str
    goal: float | None
    """The ratio that is wanted at most; None where issue 3 sets none."""
    slack: float = 0.0
    """What may come on top of goal x floor, in `unit`."""

    @property
    def ours_median(self) -> float:
        return statistics.median(self.ours)

    @property
    def floor_median(self) -> float:
        return statistics.median(self.floor)

    @property
    def ratio(self) -> float:
        return self.ours_median / self.floor_median

    @property
    def met(self) -> bool:
        return self.goal is None or self.ours_median <= self.goal * self.floor_median + self.slack

    def to_dict(self) -> dict[str, Any]:
        """One JSON object."""
        return {
            "name": self.name,
            "ours": self.ours_median,
            "floor": self.floor_median,
            "unit": self.unit,
            "ratio": self.ratio,
            "goal": self.goal,
            "slack": self.slack,
            "met": self.met,
            "ours_runs": self.ours,
            "floor_runs": self.floor,
        }


def in_turns(ours: Callable[[], T], floor: Callable[[], T]) -> tuple[list[T], list[T]]:
    """Five results of each; who goes first changes, and one turn before them warms both up."""
    ours(), floor()
    mine: list[T] = []
    least: list[T] = []
    for turn in range(RUNS):
        for run, found in ((ours, mine), (floor, least))[:: 1 if turn % 2 else -1]:
            found.append(run())
    return mine, least


def percentile(values: list[float], share: float) -> float:
    """The value that `share` of all are not above."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
