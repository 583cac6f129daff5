"""The hazards of facts about these cars, each tried on a simulated one (docs/reference/waveshare.md#hazards)."""

import json
from itertools import pairwise
from typing import Any

import pytest
from msgspec.structs import replace

from gateway.control.commands import AimServo, ChangeSpeed, Drive, EmergencyStop, Led, SetLight, SetMode, Signal, Stop
from gateway.control.driver import Event
from gateway.drivers.waveshare import driver as waveshare
from gateway.drivers.waveshare.feedback_parser import Feedback
from gateway.drivers.waveshare.ugv_platforms import FULL_SPEED
from gateway.sim.model.ir_remote import Button
from schemas.commands import Verb
from schemas.words import Basis, CarTrust, Light, Mode, Motion, Motors, Phase, Reason, Shows, SpeedStep
from tests.fuzz.ugv_search import SETTLED_S, UgvEpisode


def ready(platform: str, told: str = "", options: frozenset[str] = frozenset()) -> UgvEpisode:
    """Return a car that is set up and stands."""
    episode = UgvEpisode(1, platform, told, frozen_options=options)
    episode.connect()
    episode.run(SETTLED_S)
    return episode


def commands(episode: UgvEpisode, since: float = 0.0) -> list[dict[str, Any]]:
    """Return the commands that were written since then."""
    return [json.loads(line) for at, data in episode.sent if at >= since for line in data.split(b"\n") if line]


@pytest.mark.parametrize("platform", ["wave_rover", "ugv01", "ugv02", "ugv_rover", "ugv_beast"])
def test_ugv_moves_only_with_known_firmware_and_chassis(platform: str) -> None:
    episode = UgvEpisode(1, platform, frozen_options=frozenset())
    episode.connect()
    episode.ask(Drive(Motion.FORWARD, 1.0))
    episode.run(3.0)
    order = [each["T"] for each in commands(episode)]
    first = next(index for index, each in enumerate(commands(episode)) if each["T"] == 1 and each["L"])
    assert order.index(waveshare.CHASSIS) < first
    assert order.index(waveshare.DEAD_MAN) < first
    assert episode.faults == []
    assert episode.car.wrong_since is None


def test_wrong_firmware_is_stopped_and_never_driven() -> None:
    episode = ready("wave_rover", told="ugv_rover")
    assert episode.ask(Drive(Motion.FORWARD)) is Phase.REJECTED
    assert episode.records[-1].reason is Reason.UNSUPPORTED
    assert episode.ask(Stop()) is Phase.QUEUED
    assert all(not each.get("L") for each in commands(episode) if each["T"] == 1)
    assert episode.control.driver.model.findings.platform_contradictions


def test_held_motion_feeds_dead_man_and_is_clamped() -> None:
    episode = ready("ugv01")
    began = episode.now
    episode.ask(Drive(Motion.SPIN_LEFT, 3.0))
    episode.run(3.0)
    times = [at for at, data in episode.sent if at >= began and b'"T":1,' in data]
    assert max(b - a for a, b in pairwise(times)) <= waveshare.DEAD_MAN_MS / 1000 / 3
    assert all(abs(each[side]) <= FULL_SPEED for each in commands(episode, began) if each["T"] == 1 for side in "LR")


@pytest.mark.parametrize(
    ("platform", "options", "basis", "shows"),
    [
        ("ugv_rover", frozenset(), Basis.SHOWN, Shows.YES),
        ("ugv01", frozenset(), Basis.SHOWN, Shows.YES),
        ("wave_rover", frozenset(), Basis.SENT, Shows.NO),
        ("ugv02", frozenset(), Basis.SENT, Shows.NO),
        ("ugv_rover", frozenset({"quiet"}), Basis.SENT, Shows.UNKNOWN),
        ("ugv_rover", frozenset({"no_encoder"}), Basis.SENT, Shows.UNKNOWN),
    ],
)
def test_stop_is_shown_by_measured_wheels_only(
    platform: str, options: frozenset[str], basis: Basis, shows: Shows
) -> None:
    episode = ready(platform, options=options)
    model = episode.control.driver.model
    assert model.basis is Basis.SENT, "it was not driven yet"
    episode.ask(Drive(Motion.FORWARD, 0.8))
    episode.run(3.0)
    drive = next(each for each in episode.records if each.basis)
    assert bool(drive.evidence) is (shows is not Shows.NO), "wheels that turn show that it drove"
    episode.ask(Stop())
    episode.run(3.0)
    assert (model.motors, model.basis, model.shows) == (Motors.OFF, basis, shows)
    assert not episode.car.moving


def test_link_loss_ends_drive_by_dead_man() -> None:
    episode = ready("ugv_beast")
    episode.ask(Drive(Motion.FORWARD, 9.0))
    episode.run(1.0)
    assert episode.car.moving
    episode.cut()
    episode.run(1.6)
    assert not episode.car.moving
    assert episode.control.driver.model.motors is Motors.UNKNOWN, "nothing shows it"


def test_car_restart_repeats_setup_before_drives() -> None:
    episode = ready("ugv01")
    episode.ask(Drive(Motion.FORWARD, 9.0))
    episode.run(1.0)
    episode.car.brown_out(episode.now)
    restarted = episode.now
    episode.run(9.0)
    again = [each["T"] for each in commands(episode, restarted)]
    assert waveshare.CHASSIS in again
    assert not any(each["T"] == 1 and each["L"] for each in commands(episode, restarted + 0.3))
    assert not episode.car.moving
    assert episode.ask(Drive(Motion.BACK, 0.5)) is not Phase.REJECTED


def test_unasked_motion_is_stopped() -> None:
    episode = ready("ugv_rover")
    episode.car.press(Button.FORWARD, episode.now)
    episode.run(1.3)
    assert not episode.car.moving
    assert episode.control.driver.model.trust.state in (CarTrust.RECOVERING, CarTrust.STOPPED)


def test_open_web_page_of_car_without_encoders_is_named() -> None:
    episode = ready("wave_rover")
    episode.car.press(Button.FORWARD, episode.now)
    episode.run(8.0)
    assert "other_program" in [each.code for each in episode.logs]


def test_own_setup_frames_are_no_other_program() -> None:
    episode = ready("wave_rover")
    episode.ask(Drive(Motion.FORWARD, 2.0))
    episode.run(30.0)
    assert "other_program" not in [each.code for each in episode.logs]


def test_wheel_without_encoder_signal_ends_drive_as_stuck() -> None:
    episode = ready("ugv_rover", options=frozenset({"no_encoder"}))
    episode.ask(Drive(Motion.FORWARD, 5.0))
    episode.run(2.0)
    assert not episode.car.truth.driving
    assert [each.reason for each in episode.records if each.phase is Phase.FAILED] == [Reason.STUCK]


@pytest.mark.parametrize(("share", "reasons"), [(0.95, []), (0.0, [Reason.STUCK])])
def test_slow_inner_wheel_of_a_curve_is_not_stuck(share: float, reasons: list[Reason]) -> None:
    """At the lowest speed it shall turn at 0.02 m/s. This car's wheels turn a little slower, or the inner one not."""
    episode = ready("ugv01")
    for _ in range(10):
        episode.ask(ChangeSpeed(SpeedStep.DOWN))
        episode.run(0.5)
    driver = episode.control.driver
    parse = driver.feed

    def feed(data: bytes, now: float) -> list[Event]:
        return [
            replace(each, left_m_s=each.left_m_s * share, right_m_s=each.right_m_s * 0.95)
            if isinstance(each, Feedback)
            else each
            for each in parse(data, now)
        ]

    driver.feed = feed  # type: ignore[method-assign]  # another car
    episode.ask(Drive(Motion.LEFT, 4.0))
    episode.run(6.0)
    assert [each.reason for each in episode.records if each.phase is Phase.FAILED] == reasons


@pytest.mark.parametrize("platform", ["ugv01", "ugv_rover", "ugv_beast"])
def test_slowest_curve_is_not_stuck(platform: str) -> None:
    """Its inner wheel has less than one pulse of its encoder in a turn of the car's loop, so it often reports 0."""
    episode = ready(platform)
    for _ in range(10):
        episode.ask(ChangeSpeed(SpeedStep.DOWN))
        episode.run(0.5)
    episode.ask(Drive(Motion.LEFT, 10.0))
    episode.run(11.0)
    assert [each.reason for each in episode.records if each.phase is Phase.FAILED] == []


def test_stop_of_person_does_not_wait_for_boot() -> None:
    episode = UgvEpisode(1, "ugv_rover", frozen_options=frozenset())
    episode.car.brown_out(0.0)
    episode.connect()
    episode.run(0.2)
    assert episode.sent == [], "a boot is not disturbed"
    episode.ask(Stop())
    episode.run(0.05)
    assert commands(episode)[0] == {"T": 11, "L": 0, "R": 0, "n": 1}


def test_stop_of_person_does_not_wait_for_boot_behind_frames_of_another_stop() -> None:
    """The link opens during a boot. A fleet-wide e-stop has its first frames out, and then waits for the set-up."""
    episode = UgvEpisode(1, "ugv_rover", frozen_options=frozenset())
    episode.car.brown_out(0.0)
    episode.connect()
    episode.run(0.05)
    episode.control.halt("an e-stop of the fleet", episode.now)
    episode.run(0.5)
    sent = len(episode.sent)
    assert sent in (1, 2), "it waits, or the test shows nothing"
    episode.run(1.0)
    assert len(episode.sent) == sent
    episode.ask(Stop())
    episode.run(0.7)
    assert len(episode.sent) >= 3


def test_ugv_refuses_what_it_lacks_and_lights_work() -> None:
    episode = ready("wave_rover")
    for what in (Led(1, 2, 3), Signal(Verb.WHISTLE), AimServo(1), SetLight(Light.RED), SetMode(Mode.TRACKING)):
        assert episode.ask(what) is Phase.REJECTED
    episode.ask(SetLight(Light.WHITE))
    episode.run(0.5)
    assert episode.car.truth.led == "#ffffff"


def test_line_refuses_commands_outside_allow_list() -> None:
    for kind in (0, 2, 13, 111, 138, 140, 242, 405, 600, 603):
        with pytest.raises(AssertionError):
            waveshare.line(kind, cmd=-1)
    with pytest.raises(AssertionError):
        waveshare.line(waveshare.PWM, L=1, R=0)


# ---------------------------------------------------------------------- cars and links that differ


def test_stop_is_shown_over_slow_link() -> None:
    episode = UgvEpisode(1, "ugv_rover", frozen_options=frozenset())
    episode.delay_s = 0.4
    episode.connect()
    episode.run(SETTLED_S)
    episode.ask(Drive(Motion.FORWARD, 2.0))
    episode.run(6.0)
    assert episode.control.driver.model.basis is Basis.SHOWN


def test_stop_is_sent_if_echo_is_switched_off() -> None:
    episode = ready("ugv_rover")
    episode.ask(Drive(Motion.FORWARD, 1.0))
    episode.run(4.0)
    assert episode.control.driver.model.basis is Basis.SHOWN
    episode.car.feed(b'{"T":143,"cmd":0}\n', episode.now)
    for _ in range(2):
        episode.ask(Stop())
        episode.run(8.0)
    assert (episode.control.driver.model.motors, episode.control.driver.model.basis) == (Motors.OFF, Basis.SENT)


def test_missing_chassis_echo_locks_no_car_out() -> None:
    episode = UgvEpisode(1, "ugv01", frozen_options=frozenset())
    printed = episode.car._print
    episode.car._print = lambda data: printed(data.replace(b'"T":900', b'"T": 900'))  # type: ignore[method-assign]  # its own spelling
    episode.connect()
    episode.run(SETTLED_S)
    assert episode.ask(Drive(Motion.FORWARD, 1.0)) is not Phase.REJECTED
    episode.run(0.8)
    assert episode.car.moving
    assert len([each for each in commands(episode) if each["T"] == waveshare.CHASSIS]) <= waveshare.BLIND_TRIES


@pytest.mark.parametrize("field", ["temp", "odl"])
def test_firmware_without_one_field_is_driven(field: str) -> None:
    episode = UgvEpisode(1, "ugv01" if field == "temp" else "ugv_rover", frozen_options=frozenset())
    printed = episode.car._print
    episode.car._print = lambda data: printed(data.replace(f'"{field}"'.encode(), b'"other"'))  # type: ignore[method-assign]  # its own names
    episode.connect()
    episode.run(SETTLED_S)
    episode.ask(Drive(Motion.FORWARD, 1.0))
    episode.run(0.8)
    assert episode.car.moving


def test_firmware_change_ends_drive() -> None:
    episode = ready("ugv_rover")
    episode.ask(Drive(Motion.FORWARD, 5.0))
    episode.run(1.0)
    line = b'{"T":1001,"L":0,"R":0,"r":0,"p":0,"y":0,"temp":40,"v":11.5}\r\n'
    for event in episode.control.driver.feed(line, episode.now):
        episode.control.driver.on_event(event, episode.now)
    episode.run(0.6)
    assert not episode.car.truth.driving


def test_errors_of_servos_keep_no_car_from_its_setup() -> None:
    episode = UgvEpisode(1, "ugv_rover", frozen_options=frozenset())
    episode.connect()
    for _ in range(40):
        episode.car._print(b'{"T":1005,"id":2,"status":0}\r\n')
        episode.run(0.1)
    assert episode.control.driver.wait_words(episode.now) == ""


def test_estop_during_boot_is_repeated_and_not_counted() -> None:
    episode = ready("ugv01", options=frozenset({"mission"}))
    episode.car.brown_out(episode.now)
    episode.run(0.02)
    episode.ask(EmergencyStop("x"))
    while episode.now < SETTLED_S + 8.0:
        episode.run(0.05)
        claimed = episode.control.driver.model.motors is Motors.OFF
        assert not (claimed and episode.car.truth.driving), episode.now
    assert not episode.car.moving
    assert episode.control.driver.model.motors is Motors.OFF
