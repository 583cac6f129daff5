"""The gateway claims no drive as complete, and no mode as confirmed, if the car does not show it."""

import pytest

from gateway.control.commands import Drive, Stop
from schemas.words import CarTrust, Motion, Phase
from tests.gateway.control.workbench import MODE00
from tests.support.virtual import Pair


def driven(*, deaf: bool) -> Pair:
    """Drive a car for a second. A deaf car has shown a stop before, and receives no frame any more."""
    pair = Pair(start_s=2.0)
    pair.connect()
    pair.until(lambda: pair.control.driver.model.trust.shown, 20.0)
    if deaf:
        pair.lose_frames()
        pair.ask(Stop())
        pair.run(20.0)
    assert pair.control.driver.model.trust.state is (CarTrust.UNPROVEN if deaf else CarTrust.STOPPED)
    pair.ask(Drive(Motion.FORWARD, 1.0), identity="drive")
    pair.run(4.0)
    return pair


def test_drive_of_deaf_car_is_sent_and_not_shown() -> None:
    pair = driven(deaf=True)
    last = [record for record in pair.records if record.command.id == "drive"][-1]
    assert (last.phase, last.basis) == (Phase.SENT, "sent")
    assert "red may not have moved" in last.words


def test_drive_with_changed_distance_claims_only_that() -> None:
    """Something else may have moved before the car, and one change does not show that it drove all the time."""
    last = [record for record in driven(deaf=False).records if record.command.id == "drive"][-1]
    assert (last.phase, last.basis) == (Phase.SENT, "sent")
    assert last.evidence[0].startswith("its distance changed from ")


def test_drive_without_report_is_sent_for_its_time() -> None:
    pair = Pair(start_s=2.0).ready()
    pair.ask(Drive(Motion.FORWARD, 0.3), identity="drive")
    pair.run(1.0)
    last = pair.last_of("drive")
    assert last is not None
    assert (last.phase, last.basis, last.words) == (Phase.SENT, "sent", "sent for 0.3 s")


def test_drive_does_not_hide_unshown_stop() -> None:
    pair = Pair(start_s=2.0).ready()
    pair.ask(Drive(Motion.FORWARD, 9.0))
    pair.run(1.5)
    pair.lose_frames()
    pair.ask(Stop())
    pair.until(lambda: pair.control.driver.model.trust.state is CarTrust.UNPROVEN, 30.0)
    pair.ask(Drive(Motion.FORWARD, 0.5), identity="again")
    pair.run(12.0)
    assert pair.car.truth.driving
    last = pair.last_of("again")
    assert last is not None
    assert (last.phase, last.basis) == (Phase.SENT, "sent")
    assert pair.control.driver.model.trust.state is CarTrust.UNPROVEN, (
        "the car drives: a soft stop is no reason to say `off`"
    )
    assert MODE00 in [data for at, data in pair.sent if at > pair.now - 10.0]


@pytest.mark.parametrize("seconds", [3.0, 30.0, 90.0])
def test_old_evidence_confirms_no_mode_during_stop(seconds: float) -> None:
    pair = Pair(start_s=2.0).ready()
    assert pair.control.driver.model.mode.confirmed is not None
    pair.deaf_until = float("inf")
    pair.run(4.5)
    for _ in range(int(seconds)):
        pair.run(1.0)
        assert pair.control.driver.model.mode.confirmed is None
