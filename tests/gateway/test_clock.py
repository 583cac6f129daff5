"""Wall-clock times keep the order of their moments, even if the scheduler interrupts the process."""

import itertools
from collections.abc import Callable, Iterator

import pytest

from gateway.clock import MAX_ATTEMPTS, MIN_STEP_NS, Sleeps, WallClock

EPOCH_NS = 1_795_000_000_000_000_000
MS = 1_000_000


class Clocks:
    """A monotonic clock and a wall clock. Each reading takes the next time of `takes`, in ns."""

    def __init__(self, takes: Iterator[int]) -> None:
        self.now = 5_000 * MS
        self.ahead = EPOCH_NS
        self._takes = takes

    def monotonic_ns(self) -> int:
        self.now += next(self._takes)
        return self.now

    def wall_ns(self) -> int:
        self.now += next(self._takes)
        return self.now + self.ahead


def _wall(takes: Callable[[int], int] = lambda look: 50) -> tuple[Clocks, WallClock]:
    clocks = Clocks(map(takes, itertools.count()))
    return clocks, WallClock(clocks.monotonic_ns, clocks.wall_ns)


def test_moment_has_its_wall_time() -> None:
    clocks, wall = _wall()
    assert wall.ns(clocks.now / 1e9) == pytest.approx(clocks.now + EPOCH_NS, abs=1_000)
    assert wall.ns(4.0) == pytest.approx(4_000 * MS + EPOCH_NS, abs=1_000)


@pytest.mark.parametrize("held_up", [0, 1, 2])
def test_stalled_process_gives_one_moment_one_stamp(held_up: int) -> None:
    """Interrupt the process for 0.3 s now and then, at each of the three readings in turn."""
    clocks, wall = _wall(lambda look: 300 * MS if look % 99 == held_up + 33 else 50)
    stamps = {wall.ns(4.0) for _ in range(300)}
    assert len(stamps) == 1
    assert stamps.pop() == pytest.approx(4_000 * MS + EPOCH_NS, abs=1_000)
    assert clocks.now > 5_000 * MS + 3 * 300 * MS


def test_always_stalled_process_has_bounded_clock_error() -> None:
    _, wall = _wall(lambda look: 20 * MS)
    for _ in range(MAX_ATTEMPTS):
        assert wall.ns(4.0) == pytest.approx(4_000 * MS + EPOCH_NS, abs=20 * MS)


@pytest.mark.parametrize("step", [-3_600_000 * MS, -3 * MS, 3 * MS, 3_600_000 * MS])
def test_wall_clock_that_is_set_is_followed_at_once(step: int) -> None:
    clocks, wall = _wall()
    before = wall.ns(4.0)
    clocks.ahead += step
    assert wall.ns(4.0) - before == pytest.approx(step, abs=1_000)


def test_slewed_wall_clock_is_followed_in_steps() -> None:
    clocks, wall = _wall()
    stamps = []
    for _ in range(1_000):  # 10 us at a time, 10 ms in all
        clocks.ahead += MS // 100
        stamps.append(wall.ns(4.0) - 4_000 * MS)
        assert clocks.ahead - stamps[-1] <= MIN_STEP_NS + 1_000
    assert 4 <= len(set(stamps)) <= 6


def test_age_includes_the_sleeps_since_then() -> None:
    sleeps = Sleeps()
    assert sleeps.age_s(10.0, 12.5) == 2.5
    sleeps.add(100.0, 20.0)
    sleeps.add(1000.0, 30.0)
    assert [sleeps.age_s(at, 31.0) for at in (10.0, 20.0, 25.0, 30.0, 32.0)] == [1121.0, 1011.0, 1006.0, 1.0, 0.0]
