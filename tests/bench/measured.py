"""A measured cost and its floor. Their runs take turns, so that both meet the same state of the machine."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Scale:
    """The size of a benchmark."""

    runs: int
    """Number of runs of ours, and of the floor."""
    share: float = 1.0
    """Share of the full count, time or size of one run."""

    def count(self, full: int, least: int = 1) -> int:
        """Return this share of a full count."""
        return max(least, round(full * self.share))

    def seconds(self, full: float, least: float = 0.2) -> float:
        """Return this share of a full time."""
        return max(least, full * self.share)


FULL = Scale(runs=5)
SMALL = Scale(runs=1, share=0.01)
"""One round, which takes seconds and shows that a benchmark runs. Its figures have no meaning."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One line of the table. `ours` and `floor` have one value per run."""

    name: str
    ours: tuple[float, ...]
    floor: tuple[float, ...]
    unit: str
    goal: float | None
    """Maximum ratio, None if issue 3 sets none."""
    slack: float = 0.0
    """Allowance beside goal x floor, in `unit`. With a goal of 0 it is an absolute limit."""

    @property
    def ours_median(self) -> float:
        return statistics.median(self.ours)

    @property
    def floor_median(self) -> float:
        return statistics.median(self.floor)

    @property
    def ratio(self) -> float | None:
        """Ratio of ours to the floor, None if there is no floor."""
        return self.ours_median / self.floor_median if self.floor_median > 0 else None

    @property
    def met(self) -> bool:
        return self.goal is None or self.ours_median <= self.goal * self.floor_median + self.slack

    def to_dict(self) -> dict[str, Any]:
        """Return one JSON object."""
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


def in_turns(scale: Scale, ours: Callable[[], T], floor: Callable[[], T]) -> tuple[list[T], list[T]]:
    """Run both in turns and return the results of each. The order alternates. If runs > 1, a turn warms both up."""
    if scale.runs > 1:
        ours(), floor()
    mine: list[T] = []
    least: list[T] = []
    for turn in range(scale.runs):
        for run, found in ((ours, mine), (floor, least))[:: 1 if turn % 2 else -1]:
            found.append(run())
    return mine, least


def percentile(values: list[float], share: float) -> float:
    """Return the value at this share of the sorted values."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
