"""How often a claim is false on a cable that changes bits, and for how long.

The figures are printed. They stand in docs/explanation/what-happens-when.md.

`FLIPS=FROM:TO make soak` plays the episodes of other seeds.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import pytest

from tests.fuzz.stop_search import FALSE_S, Episode, Kind, LinkFault, Way, draw

FIRST, BEHIND = (int(seed) for seed in os.environ.get("FLIPS", "0:6000").split(":"))
SHARES = (1e-4, 1e-3, 1e-2)
"""Shares of the bytes of which a bit is changed."""
FLIPS_S = 30.0
"""Time from the stop for which the cable changes bits."""
NOTICED_S = 60.0
"""Maximum time that a false claim may last: nothing may be false for ever."""


@dataclass(frozen=True, slots=True)
class FlippedStops:
    """The stops of one episode, and how long a claim that rests on `shown` was false, each time (s)."""

    complete: int
    false_s: tuple[float, ...]
    runs_on: bool
    """True if the motors ran at the end of the episode."""


class FlippedEpisode(Episode):
    """Measures false claims, instead of failing by them."""

    def __init__(self, seed: int, share: float) -> None:
        flips = LinkFault(Kind.FLIPPED, Way.BOTH, -1.0, FLIPS_S + 1.0, share=share)
        super().__init__(replace(draw(seed), faults=(flips,), again_s=0.0, drive_again_s=0.0))
        self.false_s: list[float] = []
        self._false_since: float | None = None

    def _judge(self) -> None:
        super()._judge()
        since = [each for each in (self._on_since, self._claim_since) if each is not None]
        if len(since) == 2:
            self._false_since = max(since)
        elif self._false_since is not None:
            if self.now - self._false_since > FALSE_S:
                self.false_s.append(self.now - self._false_since)
            self._false_since = None


def flipped(case: tuple[int, float]) -> FlippedStops:
    """Play one seed on a cable that changes this share of the bytes."""
    episode = FlippedEpisode(*case)
    report = episode.play()
    if episode._false_since is not None:
        episode.false_s.append(episode.now - episode._false_since)
    return FlippedStops(report.ends["complete"], tuple(episode.false_s), "(2) the motors run" in report.violations)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("share", SHARES)
def test_false_claim_by_a_changed_bit_is_noticed(share: float) -> None:
    with ProcessPoolExecutor(2) as pool:
        stops = list(pool.map(flipped, [(seed, share) for seed in range(FIRST, BEHIND)], chunksize=50))
    shown, false_s = sum(each.complete for each in stops), sorted(one for each in stops for one in each.false_s)
    worst = [f"{one:.1f}" for one in false_s[-10:]]
    print(
        f"\n1 byte in {1 / share:g} is changed: {len(stops)} episodes, {shown} stops shown, "
        f"{len(false_s)} claims false for longer than {FALSE_S} s, the longest (s): {', '.join(worst) or 'none'}; "
        f"motors on at the end in {sum(each.runs_on for each in stops)}"
    )
    assert shown
    assert not false_s or false_s[-1] < NOTICED_S
