"""The CPU share of a gateway is that of the last second, however often its health is published."""

import pytest

from gateway.bus.process_stats import ProcessStats
from schemas.gen import fleet_v1_pb2 as pb


class ProcessClocks:
    """A monotonic clock, and the CPU time of a process."""

    def __init__(self) -> None:
        self.now = 100.0
        self.used_s = 0.4
        self.stats = ProcessStats(lambda: self.now, lambda: self.used_s)

    def cpu_after(self, seconds: float, *, used_s: float) -> float:
        """Let time pass. Return the share that is then published."""
        self.now += seconds
        self.used_s += used_s
        message = pb.Health()
        self.stats.fill(message)
        return message.cpu


def test_early_health_has_the_share_of_the_last_second() -> None:
    clocks = ProcessClocks()
    assert clocks.cpu_after(1.01, used_s=0.0101) == pytest.approx(0.01)
    assert clocks.cpu_after(1.01, used_s=0.0101) == pytest.approx(0.01)
    assert clocks.cpu_after(0.002, used_s=0.004) == pytest.approx(0.0141 / 1.012), "a finding was published early"
    assert clocks.cpu_after(1.008, used_s=0.0101) == pytest.approx(0.0101 / 1.008)


def test_share_of_a_busy_second_is_soon_over() -> None:
    clocks = ProcessClocks()
    shares = [clocks.cpu_after(0.2, used_s=0.2 if number < 10 else 0.0) for number in range(20)]
    assert shares[:10] == [pytest.approx(1.0)] * 10
    assert shares[-1] == 0.0
