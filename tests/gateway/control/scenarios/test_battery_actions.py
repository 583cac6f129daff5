"""The gateway reacts to the battery level: it warns, refuses commands that drain the battery, or stops the car."""

import pytest

from gateway.control.battery import BatteryPolicy
from gateway.control.commands import Drive, SetLight, SetMode, Stop
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.sim.model.traits import CarTraits
from schemas.rights import Sender
from schemas.words import BatteryAction, Light, Mode, Motion, Motors, Phase, Rank, Reason
from tests.gateway.control.workbench import MODE00, REPORT_S, RUN, STOP, Workbench
from tests.support.controls import control
from tests.support.virtual import Pair

FORWARD = Drive(Motion.FORWARD, 9.0)


def reading(voltage: float) -> bytes:
    return f"$4WD,CSB57.24,PV{voltage:.2f},GS5,LF0000,HW00,GM00#".encode()


def drained(desk: Workbench, voltage: float) -> None:
    for _ in range(12):
        desk.run(REPORT_S, reports=False)
        desk.hear(reading(voltage))


def test_low_is_told_of_and_critical_refuses_what_drains_it() -> None:
    desk = Workbench().ready()
    drained(desk, 6.9)
    assert [log.code for log in desk.logs] == ["battery_low"]
    assert "6.90 V" in desk.logs[0].words
    assert desk.ask(Drive(Motion.FORWARD, 0.3)).status is Phase.QUEUED
    drained(desk, 6.1)
    assert [log.code for log in desk.logs] == ["battery_low", "battery_critical"]
    for what in (FORWARD, SetMode(Mode.TRACKING)):
        refused = desk.ask(what)
        assert (refused.status, refused.reason) == (Phase.REJECTED, Reason.BATTERY_LOW)
        assert "Charge it" in refused.words
    for still in (Drive(Motion.STOP), SetMode(Mode.MANUAL), Stop(), SetLight(Light.RED)):
        assert desk.ask(still).status is not Phase.REJECTED
        desk.run(3.0)
    drained(desk, 8.0)
    assert desk.logs[-1].code == "battery_ok"
    assert desk.ask(FORWARD).status is Phase.QUEUED


@pytest.mark.parametrize("platform", ["arduino", "stm32"])
def test_empty_car_gets_no_mode_when_its_gateway_has_just_started(platform: str) -> None:
    """A plan gives a mode as soon as the car is known. The car drove in it until it was empty, and reported nothing."""
    pair = Pair(platform)
    pair.car.drain(pair.now, 1.0)
    pair.run(2.0, linked=False)
    pair.connect()
    model = pair.control.driver.model
    pair.until(lambda: model.known and model.motors is Motors.OFF, 30.0)
    refused = pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE), sender=Sender("coordinator", Rank.COORDINATOR))
    assert (refused.status, refused.reason) == (Phase.REJECTED, Reason.BATTERY_LOW)
    pair.run(30.0)
    assert not pair.driven_since(0.0)
    assert model.battery.level == "critical"


@pytest.mark.parametrize("what", [FORWARD, SetMode(Mode.TRACKING)])
def test_accepted_command_that_waits_for_car_is_not_begun_with_critical_battery(what: Drive | SetMode) -> None:
    """A mode that waited for the car was opened, and the car drove in it until it was empty."""
    desk = Workbench().ready()
    drained(desk, 6.9)
    for _ in range(5):  # the next reading makes the battery critical
        desk.run(REPORT_S, reports=False)
        desk.hear(reading(6.1))
    desk.run(REPORT_S, reports=False)
    desk.ask(SetLight(Light.RED))
    assert desk.ask(what, identity="w").status is Phase.QUEUED
    desk.hear(reading(6.1))
    assert desk.logs[-1].code == "battery_critical"
    assert desk.end("w") == (Phase.REJECTED, Reason.BATTERY_LOW)
    desk.run(10.0)
    assert RUN not in desk.frames
    assert b"$MODE20#" not in desk.frames


@pytest.mark.parametrize("platform", ["auto", "arduino+3s"])
def test_three_cells_count_also_if_they_were_detected(platform: str) -> None:
    """The thresholds stayed those of two cells, so an empty battery of three cells counted as full."""
    pair = Pair("arduino", traits=CarTraits(cells=3))
    auto = platform == "auto"
    pair.control = control(parse_platform("unknown" if auto else platform), auto=auto)
    pair.connect()
    pair.run(30.0)
    model = pair.control.driver.model
    assert (model.profile.name, model.battery.level) == ("arduino+3s", "ok")
    pair.car.drain(pair.now, 60.0)
    pair.run(90.0)
    assert [log.code for log in pair.logs if log.code.startswith("battery")] == ["battery_low", "battery_critical"]
    assert pair.ask(FORWARD).reason is Reason.BATTERY_LOW


def test_car_can_be_stopped_by_its_battery() -> None:
    desk = Workbench()
    desk.control = control(parse_platform("arduino"), battery_policy=BatteryPolicy(on_critical=BatteryAction.STOP))
    desk.ready()
    desk.ask(FORWARD, identity="d")
    desk.car.reading = reading(5.9)
    desk.run(11.0)
    assert desk.frames[0] == RUN
    assert MODE00 in desk.frames
    assert desk.control.driver.model.motors == "off"
    assert desk.end("d") == (Phase.SUPERSEDED, Reason.SUPERSEDED)
    assert STOP in desk.frames


@pytest.mark.parametrize("platform", ["raspberry_pi", "raspberry_pi+arm"])
def test_constant_is_no_battery(platform: str) -> None:
    desk = Workbench(platform)
    desk.control.link_up(desk.now)
    for _ in range(20):
        desk.run(REPORT_S, reports=False)
        desk.hear(b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#")
    assert desk.control.driver.model.battery.level is None
    assert not [log for log in desk.logs if log.code.startswith("battery")]
