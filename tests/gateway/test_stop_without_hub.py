"""A car is stopped without the bus, over a link of its own, even if its driver fails."""

import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gateway.control.driver import Event
from gateway.link import parse_url
from gateway.stop_without_hub import run_stop_alone
from tests.support import tank
from tests.support.driver_package import installed_driver
from tests.support.processes import TcpCar, wait_for
from tests.support.text_parts import has_parts


class DeafTank(tank.TankDriver):
    """It fails when it reads, and ends its stop only after that: the car's bytes may come late."""

    _has_failed = False

    def feed(self, data: bytes, now: float) -> list[Event]:
        self._has_failed = True
        raise ZeroDivisionError

    @property
    def finished(self) -> bool:
        return self._has_failed and super().finished


def log_of_failures(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [each for each in caplog.records if each.levelno == logging.ERROR]


def test_driver_that_cannot_read_is_logged_and_still_stops_car(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tank, "driver_of", lambda name, kept: DeafTank)
    tcp = TcpCar()
    where = ("red", parse_url(tcp.link), "tank", "fleet", tmp_path / "state")
    with installed_driver(tmp_path, monkeypatch, "tests.support.tank"), ThreadPoolExecutor(1) as threads:
        stopping = threads.submit(run_stop_alone, *where)
        try:
            wait_for(lambda: tcp.connections or stopping.done(), "its link is open")
            tcp.send(tank.SAMPLES[0])
            wait_for(lambda: b'"move": [0.0, 0.0]' in b"".join(tcp.received), "a stop arrives")
            wait_for(lambda: log_of_failures(caplog), "the failure is logged")
        finally:
            tcp.close()
        assert has_parts(stopping.result(), "red … moving")
    (failure,) = log_of_failures(caplog)
    assert failure.exc_info
    assert failure.exc_info[0] is ZeroDivisionError
