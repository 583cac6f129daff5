"""The simulated cars of the second family are as dangerous as facts say (docs/reference/waveshare.md)."""

import json
import random
from typing import Any

import pytest

from gateway.sim.model.factory import build_ugv
from gateway.sim.model.ugv import UGV_BOOT_S, UGV_BUILDS, UGV_DEAD_MAN_S, UGV_RX_BUFFER, WIFI_S, UgvCar
from gateway.sim.model.world import World


class Host:
    """What writes to a car, and reads what it sends."""

    def __init__(self, platform: str, *options: str) -> None:
        self.car: UgvCar = build_ugv(platform, World.room(), 0, random.Random(1), options=frozenset(options))
        self.now = 0.0
        self.heard = b""

    def send(self, *lines: str) -> "Host":
        """Send lines, and let them arrive."""
        for line in lines:
            self.car.feed(line.encode(), self.now)
        return self.run(0.1)

    def run(self, seconds: float) -> "Host":
        """Let time pass."""
        self.now += seconds
        self.heard += b"".join(data for _, data in self.car.advance(self.now))
        return self

    def feedback(self) -> dict[str, Any]:
        """Return the last whole feedback."""
        found = [each for each in self.heard.split(b"\n") if each.startswith(b'{"T":1001')]
        last: dict[str, Any] = json.loads(found[-1])
        return last

    @property
    def duty(self) -> tuple[int, int]:
        """Return the true duty of the motors."""
        return self.car.truth.motor_left, self.car.truth.motor_right


FORWARD = '{"T":1,"L":0.2,"R":0.2}\n'


@pytest.mark.parametrize("platform", ["wave_rover", "ugv01", "ugv_rover"])
def test_ugv_dead_man_stops_car(platform: str) -> None:
    main = UGV_BUILDS[platform].main
    host = Host(platform).send(f'{{"T":900,"main":{main},"module":0}}\n', FORWARD).run(1.0)
    assert host.car.moving
    host.run(UGV_DEAD_MAN_S)
    assert not host.car.moving


def test_motion_by_t13_is_never_stopped_on_one_firmware() -> None:
    twist = '{"T":13,"X":0.2,"Z":0}\n'
    host = Host("ugv_rover").run(4.0).send(twist).run(20.0)
    assert host.car.moving
    assert host.car.runaway_since is not None
    host = Host("ugv01").send('{"T":900,"main":3,"module":0}\n').run(4.0).send(twist).run(20.0)
    assert not host.car.moving


def test_ugv_negative_dead_man_never_stops() -> None:
    host = Host("ugv_rover").send('{"T":136,"cmd":-1}\n', FORWARD).run(20.0)
    assert host.car.moving


def test_too_great_numbers_keep_old_speed_and_feed_dead_man() -> None:
    host = Host("ugv_rover").send(FORWARD)
    for _ in range(10):
        host.send('{"T":1,"L":9,"R":9}\n').run(1.0)
    assert host.car.moving


@pytest.mark.parametrize(
    "line",
    ['{"T":1,"L":0.2}\n', '{"T":1,"L":"a","R":0.2}\n', "{T:1}\n", '{"T":999,"L":1,"R":1}\n', f"{'x' * 300}{FORWARD}"],
)
def test_ugv_ignores_malformed_lines_silently(line: str) -> None:
    host = Host("wave_rover").send('{"T":143,"cmd":0}\n')
    host.heard = b""
    host.send(line).run(0.5)
    assert (host.car.moving, host.heard) == (False, b"")


def test_partial_line_spoils_next_and_line_end_clears_it() -> None:
    assert not Host("wave_rover").send('{"T":1,"L":0.', FORWARD).run(0.3).car.moving
    assert Host("wave_rover").send('{"T":1,"L":0.', "\n", FORWARD).run(0.3).car.moving


def test_ugv_second_object_of_line_is_dropped() -> None:
    assert not Host("wave_rover").send('{"T":130}{"T":1,"L":0.2,"R":0.2}\n').run(0.3).car.moving


def test_ugv_half_is_full_power_on_open_loop() -> None:
    assert Host("wave_rover").send('{"T":1,"L":0.5,"R":0.5}\n').duty == (255, 255)


def test_without_encoders_the_speeds_are_nothing_or_the_command() -> None:
    host = Host("wave_rover").send('{"T":11,"L":200,"R":200}\n', '{"T":130}\n')
    assert host.feedback()["L"] == 200
    host.send('{"T":130}\n')
    assert (host.feedback()["L"], host.car.moving) == (0, True), "the command, only in the turn that obeys it"
    host.send(FORWARD).run(0.5).send('{"T":130}\n')
    assert (host.feedback()["L"], host.car.moving) == (0, True)


def test_loose_encoder_counts_neither_speed_nor_distance() -> None:
    host = Host("ugv_rover", "no_encoder").send(FORWARD).run(1.0)
    assert host.car.moving
    assert (host.feedback()["L"], host.feedback()["odl"]) == (0, 0)
    assert host.feedback()["odr"] > 0


def test_ugv_poll_within_stream_gap_has_no_answer() -> None:
    host = Host("wave_rover").send('{"T":142,"cmd":1000}\n', '{"T":130}\n')
    host.heard = b""
    assert host.send('{"T":130}\n').run(0.3).heard.count(b"1001") == 0
    assert host.run(1.0).send('{"T":130}\n').heard.count(b"1001") == 1


def test_volts_come_in_two_units() -> None:
    one = Host("wave_rover").send('{"T":130}\n').feedback()["v"]
    two = Host("ugv_rover").run(0.5).feedback()["v"]
    assert isinstance(one, float)
    assert isinstance(two, int)
    assert 9 < one < 13
    assert 900 < two < 1300


def test_reset_forgets_chassis_on_one_firmware() -> None:
    host = Host("ugv01").send('{"T":900,"main":3,"module":0}\n')
    host.car.brown_out(host.now)
    host.run(UGV_BOOT_S + 0.5).send(FORWARD).run(0.5)
    assert host.duty[0] > 0
    assert host.car.wrong_since is not None
    assert host.car._wheels[0] < 0


def test_ugv_boot_mission_drives_and_early_byte_aborts_it() -> None:
    host = Host("ugv_rover", "mission")
    host.car.brown_out(host.now)
    assert host.run(UGV_BOOT_S + 3.0).heard.startswith(b"ets")
    host.car.brown_out(host.now)
    host.run(1.0).send("\n").run(UGV_BOOT_S + 2.0)
    assert not host.car.moving


def test_ugv_delay_command_suspends_dead_man() -> None:
    host = Host("ugv_rover").send(FORWARD).run(0.5).send('{"T":111,"cmd":8000}\n').run(6.0)
    assert host.car.moving


def test_ugv_t0_stops_on_ros_firmware_only() -> None:
    for empty in ('{"T":0}\n', "{}\n", "[]\n"):
        assert not Host("ugv_rover").send(FORWARD).run(0.5).send(empty).run(0.5).car.moving
    host = Host("ugv01").send('{"T":900,"main":3,"module":0}\n', FORWARD).run(0.5).send('{"T":0}\n').run(0.5)
    assert host.car.moving


def test_ugv_answer_without_line_end_glues_next_feedback() -> None:
    host = Host("ugv_rover").run(0.2)
    host.heard = b""
    host.send('{"T":405}\n').run(0.3)
    assert b'"ssid":"UGV"}{"T":1001' in host.heard


def test_http_runs_a_command_that_is_cut() -> None:
    host = Host("ugv_rover")
    host.car.take_http('{"T":11,"L":200,"R":2', host.now)
    assert host.run(0.1).duty == (200, 2)
    assert not host.run(UGV_DEAD_MAN_S + 0.5).car.moving


def test_wifi_search_delays_commands_and_dead_man() -> None:
    host = Host("wave_rover").send(FORWARD)
    host.car.take_http('{"T":404}', host.now)
    host.run(UGV_DEAD_MAN_S).send('{"T":1,"L":0,"R":0}\n').run(WIFI_S - UGV_DEAD_MAN_S - 1.0)
    assert host.car.moving
    assert not host.run(1.5).car.moving


def test_endless_mission_delays_dead_man_until_a_byte() -> None:
    host = Host("wave_rover").send(FORWARD, '{"T":242,"name":"dance"}\n').run(20.0)
    assert host.car.moving
    assert not host.send("\n").run(0.5).car.moving, "the dead-man was due for long"


@pytest.mark.parametrize("platform", ["ugv01", "ugv_rover"])
def test_arm_numbers_replace_other_fields(platform: str) -> None:
    host, place = Host(platform, "arm").send('{"T":130}\n'), "y" if platform == "ugv01" else "ay"
    of_arm = host.feedback()[place]
    main = UGV_BUILDS[platform].main
    assert host.send(f'{{"T":900,"main":{main},"module":0}}\n', '{"T":130}\n').feedback()[place] != of_arm


def test_ugv_missing_gimbal_slows_feedback() -> None:
    host = Host("ugv01", "gimbal").send('{"T":131,"cmd":1}\n')
    host.heard = b""
    assert host.run(2.0).heard.count(b'{"T":1001') in (9, 10, 11)
    assert host.heard.count(b'{"T":1005') == pytest.approx(20, abs=2)


@pytest.mark.parametrize("platform", ["wave_rover", "ugv_rover"])
@pytest.mark.parametrize(
    "line",
    [
        '{"T":1e999}',
        '{"T":"1e999"}',
        '{"T":1,"L":NaN,"R":0}',
        '{"T":1,"L":1e999,"R":1e999}',
        '{"T":4,"cmd":1e999}',
        '{"T":11,"L":1e999,"R":-1e999}',
        '{"T":13,"X":1e999,"Z":1e999}',
        '{"T":111,"cmd":1e999}',
        '{"T":132,"IO4":1e999,"IO5":1e999}',
        '{"T":900,"main":1e999,"module":-1e999}',
        "[" * 250,
    ],
)
def test_ugv_survives_any_number(platform: str, line: str) -> None:
    host = Host(platform).send(f"{line}\n").run(0.5).send('{"T":1,"L":0,"R":0}\n', '{"T":130}\n').run(2.0)
    assert (host.feedback()["T"], host.car.truth.alive) == (1001, True)


@pytest.mark.parametrize("what", ['{"T":111,"cmd":2000}\n', '{"T":404}\n'])
def test_stop_behind_a_blocking_line_waits_for_the_block(what: str) -> None:
    host = Host("wave_rover").send(FORWARD).run(0.5).send(f'{what}{{"T":1,"L":0,"R":0}}\n').run(1.5)
    assert host.car.moving
    assert not host.run(WIFI_S).car.moving


def test_ugv_stop_is_lost_if_the_buffer_is_full() -> None:
    host = Host("ugv_rover").send('{"T":136,"cmd":-1}\n', FORWARD, '{"T":111,"cmd":2000}\n')
    for _ in range(UGV_RX_BUFFER // len(FORWARD)):
        host.send(FORWARD)
    assert host.send('{"T":1,"L":0,"R":0}\n').run(5.0).car.moving
    assert host.car.lost_bytes > 0


def test_byte_in_the_buffer_ends_a_mission_at_once() -> None:
    host = Host("wave_rover").send('{"T":242,"name":"dance"}\n' + FORWARD).run(0.5)
    assert host.car.moving


def test_too_great_numbers_turn_the_speed_loop_on() -> None:
    host = Host("ugv_rover").send('{"T":11,"L":200,"R":200}\n').run(0.3).send('{"T":1,"L":9,"R":9}\n').run(1.0)
    assert not host.car.moving, "the speed loop still has its old speed, which is 0"


def test_doubled_speed_is_ignored_if_the_scale_is_a_half() -> None:
    host = Host("ugv_rover").send('{"T":138,"L":0.5,"R":0.5}\n', '{"T":1,"L":0.2,"R":0.2}\n').run(1.5)
    before = host.duty
    host.send('{"T":1,"L":0.4,"R":0.4}\n').run(1.5)
    assert host.duty == pytest.approx(before, abs=15)
    assert not host.send('{"T":1,"L":0,"R":0}\n').run(1.0).car.moving


def test_gains_that_are_missing_keep_the_power() -> None:
    host = Host("ugv_rover").send(FORWARD).run(1.0).send('{"T":2}\n', '{"T":1,"L":0,"R":0}\n').run(1.0)
    assert host.car.moving
    assert not host.send('{"T":11,"L":0,"R":0}\n').run(1.0).car.moving


def test_pins_are_low_until_the_speed_loop_sets_them_again() -> None:
    host = Host("ugv_rover").send('{"T":11,"L":200,"R":200}\n').run(0.5).send('{"T":115}\n').run(0.5)
    assert not host.car.moving
    assert host.send(FORWARD).run(0.5).send('{"T":115}\n').run(0.5).car.moving


def test_odometer_counts_back() -> None:
    host = Host("ugv_rover").send(FORWARD).run(2.0).send('{"T":1,"L":-0.2,"R":-0.2}\n').run(2.5)
    host.send('{"T":1,"L":0,"R":0}\n').run(1.0)
    assert abs(host.feedback()["odl"]) < 20
    host.send('{"T":1,"L":-0.2,"R":-0.2}\n').run(2.5)
    assert host.feedback()["odl"] < -20


def test_wrong_chassis_measures_other_speeds() -> None:
    host = Host("ugv_rover").send('{"T":900,"main":1,"module":0}\n', FORWARD).run(2.0)
    true_m_s = 0.5 * host.duty[0] / 255
    assert true_m_s > 0.45, "it counts 660 pulses where it expects 2100, so it drives three times as fast"
    assert host.feedback()["L"] == pytest.approx(0.2 * true_m_s / 0.5, abs=0.1)


def test_slow_wheel_often_reports_nothing() -> None:
    host = Host("ugv_rover").send('{"T":1,"L":0.02,"R":0.02}\n').run(2.5)
    host.heard = b""
    for _ in range(5):
        host.send('{"T":1,"L":0.02,"R":0.02}\n').run(0.5)
    found = [json.loads(each)["L"] for each in host.heard.split(b"\r\n") if each.startswith(b'{"T":1001')]
    assert 0.1 < found.count(0) / len(found) < 0.9
    assert min(each for each in found if each > 0) > 0.03


def test_early_byte_skips_the_stored_chassis() -> None:
    host = Host("ugv_beast").send('{"T":900,"main":3,"module":0}\n')
    for early, wrong in (("", False), ("\n", True)):
        host.car.brown_out(host.now)
        host.run(1.0).send(early).run(UGV_BOOT_S + 0.5).send(FORWARD).run(0.3)
        assert (host.car.wrong_since is not None) is wrong
        assert host.car._wheels[0] < 0 if wrong else host.car._wheels[0] > 0


def test_boot_and_ros_chassis_print_the_mission() -> None:
    host = Host("ugv_beast").send('{"T":900,"main":3,"module":0}\n')
    assert b"new mm_json appended." in host.heard
    host.heard = b""
    host.car.brown_out(host.now)
    host.run(UGV_BOOT_S + 0.5)
    assert b'[StepNum: 1 ] - {"T":900,"main":3,"module":0}\r\n' in host.heard
    assert b"[missionPlay finished.]\r\n" in host.heard


def test_reset_cuts_the_feedback_that_is_being_sent() -> None:
    host = Host("ugv_rover").run(1.0)
    while not host.car._out:
        host.run(0.001)
    host.heard = b""
    host.run(0.003).car.brown_out(host.now)
    host.run(1.0)
    part, _, _ = host.heard.partition(b"ets ")
    assert part.startswith(b'{"T":1001')
    assert b"}" not in part, "only a part of it was on the wire"
