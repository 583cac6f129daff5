"""The time that the computer slept is measured by two clocks. An interrupted process has not slept."""

import random
import subprocess
import sys
import textwrap
import time

import pytest

from schemas.process.computer_sleep import MAX_READS, MIN_SLEEP_S, SleepWatch, clock_pair
from tests.support.processes import freeze


class Computer:
    """A computer that can sleep, and that may interrupt the process at any reading of a clock."""

    def __init__(self) -> None:
        self.awake_s, self.slept_s = 100.0, 50.0
        self.interrupts: list[float] = []

    def _look(self) -> None:
        self.awake_s += self.interrupts.pop() if self.interrupts else 1e-7

    def total(self) -> float:
        self._look()
        return self.awake_s + self.slept_s

    def awake(self) -> float:
        self._look()
        return self.awake_s

    def watch(self) -> SleepWatch:
        return SleepWatch((self.total, self.awake))


@pytest.mark.parametrize("slept_s", [MIN_SLEEP_S + 0.01, 1.0, 12.0, 3600.0, 1e6])
def test_sleep_is_told_once(slept_s: float) -> None:
    computer = Computer()
    watch = computer.watch()
    assert watch.take() == 0
    computer.slept_s += slept_s
    assert watch.take() == pytest.approx(slept_s, abs=0.001)
    assert watch.take() == 0


def test_time_that_passes_awake_is_no_sleep() -> None:
    computer = Computer()
    watch = computer.watch()
    for _ in range(100):
        computer.awake_s += 1000.0
        assert watch.take() == 0


@pytest.mark.parametrize("seed", range(50))
def test_interruption_is_no_sleep_and_hides_none_for_long(seed: int) -> None:
    draw = random.Random(seed)
    computer = Computer()
    computer.interrupts = [draw.choice((1e-6, 3.0)) for _ in range(3 * draw.randrange(MAX_READS))]
    watch = computer.watch()
    told = 0.0
    for slept_s in (0.0, 0.0, 5.0, 0.0, 7.0):
        computer.slept_s += slept_s
        computer.interrupts = [draw.choice((1e-6, 3.0)) for _ in range(3)]
        found = watch.take()
        assert found == 0 or found > 1.9, "what is told is a sleep"
        told += found
    computer.interrupts.clear()
    told += watch.take()
    assert told == pytest.approx(12.0, abs=MIN_SLEEP_S)


def test_without_clocks_nothing_is_told() -> None:
    watch = SleepWatch(None)
    assert watch.take() == 0


@pytest.mark.skipif(sys.platform not in ("linux", "darwin", "win32"), reason="no sleep is noticed on this system")
def test_clocks_of_this_system_agree_while_it_is_awake() -> None:
    clocks = clock_pair()
    assert clocks is not None
    with_sleep, awake = clocks
    assert with_sleep() >= awake() - MIN_SLEEP_S
    watch = SleepWatch(clocks)
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        assert watch.take() == 0


def test_process_that_is_stopped_has_not_slept() -> None:
    """The clocks of the system are the point here, so it is a real process."""
    program = """
        import sys
        from schemas.process.computer_sleep import SleepWatch, clock_pair
        watch, told = SleepWatch(clock_pair()), 0.0
        print("ready", flush=True)
        while not sys.stdin.readline():
            told += watch.take()
        for _ in range(1000):
            told += watch.take()
        print(told, flush=True)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        freeze(process.pid)
        stopped_at = time.monotonic()
        while time.monotonic() < stopped_at + 0.4:
            pass
        process.send_signal(18)
        told, _ = process.communicate("end\n", timeout=20)
    assert float(told) == 0
