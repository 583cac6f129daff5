"""The coordinator on a computer that sleeps."""

from typing import Any, cast

import pytest

from fleet.coordinator import coordinator
from fleet.coordinator.coordinator import Coordinator
from fleet.coordinator.observer import FleetObserver
from fleet.policy.plan.plan_parser import parse
from schemas.process.computer_sleep import SleepWatch
from tests.fleet.coordinator.test_observer import come, said


def test_coordinator_lets_its_readings_age_by_a_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    for counted, aged_s in ((False, 3600.0), (True, 0.0)):
        monkeypatch.setattr(coordinator, "MONOTONIC_COUNTS_SLEEP", counted)
        slept_s = [0.0]

        def with_sleep(slept_s: list[float] = slept_s) -> float:
            return 100.0 + slept_s[0]

        one = Coordinator(
            cast("Any", None), parse("roles: {scout: {mode: manual}}"), print, print,
            sleep=SleepWatch((with_sleep, lambda: 100.0)),
        )  # fmt: skip
        observer = FleetObserver()
        come(observer, "red", 100.0)
        observer.on_sample(said("sensor/range"), 100.0, None)
        one._check_sleep(observer, 100.1)
        assert observer.states["red"].newest_by_topic["sensor/range"].at == 100.0
        slept_s[0] += 3600.0
        one._check_sleep(observer, 100.2)
        assert observer.states["red"].newest_by_topic["sensor/range"].at == 100.0 - aged_s
