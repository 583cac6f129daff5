"""Blocks, modes, readings, speed and resets of the programs, on virtual time; sources: docs/reference/protocol.md."""

import math
import random
import re
from collections.abc import Callable

import pytest

from gateway.sim.model.arduino import ArduinoCar
from gateway.sim.model.car_body import CarBody
from gateway.sim.model.firmware_base import CarBodyState, Pose, Truth
from gateway.sim.model.objects import Lamp
from gateway.sim.model.raspberry_pi import RaspberryPiCar
from gateway.sim.model.stm32 import STM32_TRAITS
from gateway.sim.model.traits import SIM_FIRST_READING_S, CarTraits
from gateway.sim.model.world import World
from schemas.words import Mode
from tests.gateway.sim.strangers import (
    FAN,
    MODE00,
    PTZ90,
    RUN,
    STOP,
    WHISTLE,
    VirtualStranger,
    opening,
    opening_s,
    virtual,
)


def general(**places: int) -> bytes:
    order = ("motion", "spin", "whistle", "speed", "servo", "sing", "light", "fan", "reset")
    return ("$" + ",".join(str(places.get(place, 0)) for place in order) + "#").encode()


BLOCKS = [
    ("general frame with motion", RUN, 0.0, 0.06),
    ("general frame with light", general(light=3), 0.0, 0.06),
    ("general frame with speed", general(speed=1), 0.0, 0.06),
    ("whistle", WHISTLE, 0.30, 0.30),
    ("PTZ", PTZ90, 0.65, 0.65),
    ("front servo left", general(servo=1), 0.65, 0.65),
    ("front servo right", general(servo=2), 0.65, 0.65),
    ("front servo reset", general(reset=1), 0.65, 0.65),
    ("colour frame", b"$4WD,CLR255,CLG0,CLB16#", 0.10, 0.10),
    ("mode closed", MODE00, 1.0, 1.0),
    *((f"mode {x} opened", opening(x), opening_s(x), opening_s(x)) for x in range(1, 7)),
]


@pytest.mark.parametrize(("what", "frame", "least", "most"), BLOCKS, ids=[row[0] for row in BLOCKS])
async def test_frame_sent_while_blocked_is_obeyed_later(what: str, frame: bytes, least: float, most: float) -> None:
    car = virtual()
    await car.wait(0.2)  # well before the first report
    await car.write(frame)
    obeyed = car.now + len(frame) / 960
    # The car obeys a close in any mode, and stops its motors. A run before the close makes that visible in mode 0.
    await car.wait(len(frame) / 960)
    await car.write(b"$4WD,MODE10#" if "opened" in what else general(motion=2))
    await car.until(
        lambda truth: truth.motor_left < 0 or (truth.mode == "manual" and "opened" in what and car.now > obeyed + 0.1)
    )
    took = car.car.motor_log[-1][0] - obeyed if "opened" not in what else car.now - obeyed
    assert max(least, 19 / 960) - 0.03 <= took <= most + 0.06


@pytest.mark.parametrize(
    ("frame", "block_s"),
    [
        (MODE00, 1.000),
        (WHISTLE, 0.304),
        (PTZ90, 0.636),
        (general(reset=1), 0.637),
        (b"$4WD,CLR255,CLG0,CLB16#", 0.101),
        (RUN, 0.0),
        (general(light=3), 0.0),
    ],
)
async def test_frame_delays_next_report_by_just_its_block(frame: bytes, block_s: float) -> None:
    """As measured: docs/reference/protocol.md#programs-that-people-have."""
    car = virtual(world=World([(1.3, -9.0, 1.3, 9.0)]))
    ends = []
    for number in range(4):
        seen = car.received.count(b"#")
        await car.until(lambda _, seen=seen: car.received.count(b"#") > seen)
        ends.append(car.now)
        if number == 1:
            await car.wait(0.3)
            await car.write(frame)
    assert ends[2] - ends[1] == pytest.approx(1.254 + block_s, abs=0.003)
    assert ends[3] - ends[2] == pytest.approx(1.254, abs=0.01)


def test_opening_times_are_those_of_the_table() -> None:
    assert [round(opening_s(x), 1) for x in (1, 6)] == [2.5, 3.5]


@pytest.mark.parametrize(("echo", "least", "most"), [(True, 0.004, 0.040), (False, 1.0, 1.0)])
async def test_report_blocks_car(echo: bool, least: float, most: float) -> None:
    blocks = []
    for sent_at in range(60):
        # The car obeys a frame at once, or after the report that it met.
        car = virtual(world=World.room() if echo else World.open_field())
        await car.wait(0.5 + sent_at / 40)
        start = car.now + len(RUN) / 960
        await car.write(RUN)
        await car.until(lambda truth: truth.driving)
        blocks.append(car.car.motor_log[-1][0] - start)
    assert min(blocks) < 1e-6
    assert max(blocks) <= most + 1e-6
    assert max(blocks) >= least / 2


async def test_motion_comes_after_whatever_else_in_the_frame_blocks() -> None:
    car = virtual()
    await car.write(general(motion=1, whistle=1, servo=1, reset=1))
    await car.until(lambda truth: truth.driving)
    assert car.car.motor_log[-1][0] == pytest.approx(19 / 960 + 0.304 + 0.637 + 0.637)


async def test_raspberry_pi_fan_blocks_for_one_second() -> None:
    for tcp in (False, True):
        car = virtual("raspberry_pi", tcp=tcp)
        await car.write(FAN)
        await car.until(lambda truth: truth.blocked)
        start = car.now
        await car.until(lambda truth: not truth.blocked)
        assert car.now - start == pytest.approx(1.0, abs=0.01)


async def frames(car: VirtualStranger, seconds: float) -> bytes:
    await car.wait(0.3)
    car.received.clear()
    await car.wait(seconds)
    return bytes(car.received)


FILLER = [
    (2, rb"\$4WD,CSB0,PV8,GS0,LF[01]{4},HW00,GM00#", 27),
    (5, rb"\$4WD,CSB120,PV8\.3,GS000,LF0000,HW00,GM[01]{2}#", 1 / 0.107),
    (6, rb"\$4WD,CSB120,PV8\.3,GS000,LF0000,HW[01]{2},GM00(?=\$)", 24),
]


@pytest.mark.parametrize(("mode", "frame", "rate"), FILLER)
async def test_filler_and_rate_of_the_modes_that_talk(mode: int, frame: bytes, rate: float) -> None:
    car = virtual()
    await car.write(opening(mode))
    await car.wait(opening_s(mode) + SIM_FIRST_READING_S)
    data = await frames(car, 20)
    found = re.findall(frame, data)
    assert b"".join(found) == data[data.index(b"$") : data.index(b"$") + sum(map(len, found))]
    assert len(found) / 20 == pytest.approx(rate, rel=0.05)


@pytest.mark.parametrize(("mode", "motors_s", "reading_s"), [(2, 2.71, 4.4), (5, 3.3, 4.9)])
async def test_readings_of_a_mode_begin_long_after_its_motors(mode: int, motors_s: float, reading_s: float) -> None:
    """As measured: docs/reference/protocol.md#programs-that-people-have."""
    car = virtual(world=World(line=((-1.0, -1.3), (1.0, -1.3), (1.0, 1.3), (-1.0, 1.3)), lamps=[Lamp(0.3, -1.3)]))
    await car.write(opening(mode))
    await car.until(lambda truth: truth.driving)
    assert car.now == pytest.approx(motors_s, abs=0.1)
    car.received.clear()
    await car.until(lambda _: bool(car.received))
    assert car.now == pytest.approx(reading_s, abs=0.15)


@pytest.mark.parametrize("mode", [1, 3, 4])
async def test_arduino_silent_modes_send_no_report(mode: int) -> None:
    car = virtual()
    await car.write(opening(mode))
    assert await frames(car, 10) == b""


FULL = rb"\$4WD,CSB(\d+\.\d\d),PV(\d\.\d\d),GS(\d{1,4}),LF[01]{4},HW[01]{2},GM[01]{2}#"
PI_FULL = rb"\$4WD,CSB(\d+),PV8\.4,GS0,LF[01]{4},HW[01]{2},GM[01]{2}#"


@pytest.mark.parametrize(
    ("platform", "tcp", "frame"),
    [
        ("arduino", False, FULL),
        ("stm32", False, FULL),
        ("raspberry_pi", False, PI_FULL),
        ("raspberry_pi", True, PI_FULL),
    ],
)
async def test_mode_0_reports_at_the_interval_of_its_program(platform: str, tcp: bool, frame: bytes) -> None:
    car = virtual(platform, tcp=tcp)
    data = await frames(car, 30)
    found = list(re.finditer(frame, data))
    assert sum(len(match[0]) for match in found) == pytest.approx(len(data), abs=60)
    interval_s = STM32_TRAITS.interval_s if platform == "stm32" else CarTraits().interval_s
    assert len(found) == pytest.approx(30 / interval_s, abs=1.5)
    assert all(2 <= float(match[1]) <= 500 for match in found)


@pytest.mark.parametrize(("platform", "word"), [("arduino", b"CSB0.00,"), ("raspberry_pi", b"CSB0,")])
async def test_without_echo(platform: str, word: bytes) -> None:
    car = virtual(platform, world=World.open_field())
    data = await frames(car, 20)
    assert data.count(word) == data.count(b"CSB") == pytest.approx(10, abs=1)


async def test_raspberry_pi_greets_over_serial_link() -> None:
    car = virtual("raspberry_pi")
    await car.wait(0.1)
    assert car.received == b"serial is on!"


async def test_car_sends_no_faster_than_uart() -> None:
    car = virtual()
    await car.write(opening(2))
    await car.wait(5)
    car.received.clear()
    await car.wait(10)
    assert 9000 < len(car.received) <= 9600 + 20


async def test_more_than_64_bytes_while_blocked_are_lost() -> None:
    car = virtual()
    await car.write(MODE00)
    await car.until(lambda truth: truth.blocked)
    await car.write(b"x" * 60 + RUN)
    await car.wait(1.5)
    assert not car.truth.driving
    assert car.car.lost_bytes == 15
    await car.write(b"," * 14 + b"#")  # the car has "$1,0", and any rest completes the frame
    await car.until(lambda truth: truth.driving)


async def test_wedged_arduino_string_is_bounded() -> None:
    car = virtual()
    await car.write(b"$4WD,nonsense#")
    await car.wait(0.1)
    await car.write(STOP * 200)
    await car.wait(5)
    assert isinstance(car.car, ArduinoCar)
    assert len(car.car._string) == 512


SPEED = [
    ("arduino", False, [150, 200, 250, 255, 255], [205, 155, 105, 55, 100, 50, 100]),
    ("raspberry_pi", True, [204, 255, 255], [204, 153, 102, 51, 51]),
    ("raspberry_pi", False, [128, 178, 230, 255, 255], [204, 153, 102, 51, 51]),
]


@pytest.mark.parametrize(("platform", "tcp", "up", "down"), SPEED)
async def test_speed_is_relative_with_odd_steps(platform: str, tcp: bool, up: list[int], down: list[int]) -> None:
    """The two programs of the Raspberry Pi begin at 80 and at 50 % (docs/reference/protocol.md#platforms)."""
    car = virtual(platform, tcp=tcp)
    seen = [car.truth.speed]
    for _ in up[1:]:
        await car.write(general(motion=1, speed=1))
        await car.wait(0.1)
        seen.append(car.truth.speed)
        assert car.truth.motor_left == car.truth.speed
    assert seen == up
    seen = []
    for _ in down:
        await car.write(general(motion=1, speed=2))
        await car.wait(0.1)
        seen.append(car.truth.speed)
    assert seen == down


MOTIONS = [
    (general(motion=0), (0, 0)),
    (general(motion=1), (150, 150)),
    (general(motion=2), (-150, -150)),
    (general(motion=3), (0, 150)),
    (general(motion=4), (150, 0)),
    (general(spin=1), (-150, 150)),
    (general(spin=2), (150, -150)),
    (general(motion=1, spin=2), (150, -150)),
    (general(motion=9), (0, 0)),
]


@pytest.mark.parametrize(("frame", "motors"), MOTIONS)
async def test_motions_by_position(frame: bytes, motors: tuple[int, int]) -> None:
    car = virtual()
    await car.write(RUN)
    await car.wait(0.1)
    await car.write(frame)
    await car.wait(0.1)
    assert (car.truth.motor_left, car.truth.motor_right) == motors


SAYS: list[tuple[bytes, Callable[[Truth], object], object]] = [
    (b"$4WD,PTZ30#", lambda truth: truth.servo, 150),
    (general(servo=1), lambda truth: truth.servo, 180),
    (general(servo=2), lambda truth: truth.servo, 0),
    (b"$4WD,CLR255,CLG0,CLB16#", lambda truth: truth.led, "#ff0010"),
    (FAN, lambda truth: truth.fan, True),
]


@pytest.mark.parametrize(("frame", "what", "value"), SAYS)
@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
async def test_frame_sets_truth_of_car(
    platform: str, frame: bytes, what: Callable[[Truth], object], value: object
) -> None:
    car = virtual(platform)
    await car.write(frame)
    await car.wait(1.2)
    assert what(car.truth) == value


async def test_all_lights_of_an_arduino() -> None:
    car = virtual()
    seen = []
    for digit in range(1, 9):
        await car.write(general(light=digit))
        await car.wait(0.1)
        seen.append(car.truth.led)
    assert seen == ["#ffffff", "#ff0000", "#00ff00", "#0000ff", "#00ffff", "#ff00ff", "#ffff00", "off"]


async def test_fan_frame_toggles_and_zero_leaves_it() -> None:
    car = virtual()
    for frame, on in ((FAN, True), (STOP, True), (FAN, False), (STOP, False)):
        await car.write(frame)
        await car.wait(0.1)
        assert car.truth.fan is on


async def test_color_frame_leaves_motors_alone() -> None:
    car = virtual()
    await car.write(RUN)
    await car.wait(0.1)
    await car.write(b"$4WD,CLR255,CLG0,CLB16#")
    await car.wait(0.5)
    assert car.truth.driving


async def test_options_send_and_accept_their_frames() -> None:
    for platform in ("arduino", "raspberry_pi"):
        car = virtual(platform, options="arm imu")
        await car.write(b"$4WD,ServoJ110,J220,J330,J440,J550,J660#")
        await car.wait(5)
        assert b"$4WD,J110,J220,J330,J440,J550,J660#" in car.received
        assert re.search(rb"\$4WD,MPUgx-?\d+,MPUgy-?\d+,MPUgz-?\d+,MPUax-?\d+,MPUay-?\d+,MPUaz1\d+#", car.received)
        await car.write(RUN)
        await car.until(lambda truth: truth.driving)


def lit_body(lamp: Lamp) -> CarBodyState:
    world = World.room()
    return CarBody(World(world.walls, world.line, [lamp]), Pose(0.0, -1.05, 0.0), random.Random(1))


async def test_light_seeking_drives_to_lamp_and_brakes_in_dark() -> None:
    car = VirtualStranger(ArduinoCar(lit_body(Lamp(1.0, -1.05)), random.Random(1)))
    await car.write(opening(5))
    await car.until(lambda truth: truth.driving)
    await car.until(lambda truth: not truth.driving)
    assert car.car.pose(car.now).x_m > 0.8


async def test_following_uses_infrared_with_inverted_bits() -> None:
    wall = World([(0.5, -1.0, 0.5, 1.0)])
    for x, word in ((0.0, b"HW11"), (0.25, b"HW00")):
        body = CarBody(wall, Pose(x, 0.0, 0.0), random.Random(1))
        car = VirtualStranger(ArduinoCar(body, random.Random(1)))
        await car.write(opening(6))
        await car.wait(opening_s(6) + SIM_FIRST_READING_S + 0.1)
        assert word in car.received
        assert car.truth.driving == (word == b"HW00")


async def test_colour_led_mode_turns_every_three_quarters_of_a_second() -> None:
    car = virtual()
    await car.write(opening(4))
    await car.wait(opening_s(4) + 0.1)
    seen = []
    for _ in range(4):
        led = car.truth.led
        start = car.now
        await car.until(lambda truth, led=led: truth.led != led)
        seen.append(car.now - start)
    assert seen[1:] == pytest.approx([0.75] * 3, abs=0.02)


async def test_avoidance_without_echo_is_braked_and_deaf_for_ever() -> None:
    car = virtual(world=World.open_field())
    await car.write(RUN)
    await car.wait(0.1)
    await car.until(lambda truth: truth.blocked)  # a report, without echo
    await car.until(lambda truth: not truth.blocked)
    await car.write(opening(3))
    await car.until(lambda truth: truth.mode == "obstacle_avoidance")
    assert car.truth.driving
    await car.wait(4)
    assert not car.truth.driving
    await car.write(MODE00)
    await car.wait(600)
    assert car.truth.mode == "obstacle_avoidance"
    assert car.truth.blocked


async def test_avoidance_near_obstacle_is_deaf_for_4_3_s() -> None:
    longest = 0.0
    for seed in range(8):
        car = virtual(seed=seed)
        await car.write(opening(3))
        await car.wait(opening_s(3) + seed)
        since = 0.0
        for _ in range(6000):
            await car.wait(0.01)
            since = since + 0.01 if car.truth.blocked else 0.0
            longest = max(longest, since)
    assert 3.9 < longest <= 4.31


async def test_brown_out_boots_to_mode_0_with_motors_off() -> None:
    car = virtual()
    await car.write(general(motion=1, speed=1, light=2, fan=1))
    await car.wait(0.1)
    await car.write(opening(2))
    await car.wait(0.1)
    assert car.truth.driving
    await car.write(b"$1,0,0")
    await car.wait(0.1)
    car.car.brown_out(car.now)
    assert car.truth == Truth(Mode.MANUAL, 0, 0, False, False, "off", 90, 150, True)
    await car.write(RUN)  # during the boot
    await car.wait(0.6)
    assert not car.truth.driving
    await car.write(STOP)  # the buffer has no half frame
    await car.wait(0.1)
    assert not car.truth.driving
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)


async def test_brown_out_truncates_frame_in_transit() -> None:
    car = virtual()
    await car.until_received(20)
    car.car.brown_out(car.now)
    await car.wait(0.3)
    assert b"#" not in car.received


async def test_dropped_link_loses_bytes_and_leaves_half_frame() -> None:
    car = virtual()
    await car.write(RUN)
    await car.wait(0.012)
    car.car.drop_link(car.now)
    await car.wait(1)
    assert not car.truth.driving
    await car.write(STOP)
    await car.wait(0.1)
    assert car.truth.driving  # row "half a general frame, then a stop"


@pytest.mark.parametrize("tcp", [True, False])
async def test_raspberry_pi_camera_turns_until_stopped(tcp: bool) -> None:
    """Over TCP, 8 resets nothing (docs/reference/protocol.md#general-frame)."""
    car = virtual("raspberry_pi", tcp=tcp)
    assert isinstance(car.car, RaspberryPiCar)
    await car.write(general(servo=6))
    await car.wait(1)
    turned = car.car.camera["horizontal"]
    assert turned > 100
    await car.write(STOP)
    await car.wait(1)
    assert car.car.camera["horizontal"] == pytest.approx(turned, abs=1)
    await car.write(general(servo=8))
    await car.wait(0.1)
    assert car.car.camera["horizontal"] == pytest.approx(turned if tcp else 90, abs=1)


async def test_raspberry_pi_recovers_from_brown_out() -> None:
    car = virtual("raspberry_pi")
    await car.write(b"$0#")
    await car.until(lambda truth: not truth.alive)
    car.car.brown_out(car.now)
    await car.wait(3)
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)


async def test_same_seed_same_bytes_same_car() -> None:
    async def life(seed: int) -> tuple[bytes, object, object]:
        car = virtual(seed=seed)
        moments = random.Random(9)
        for mode in (0, 2, 3, 4, 6, 5, 0):
            await car.write(opening(mode) if mode else MODE00)
            await car.wait(3 + 5 * moments.random())
        return bytes(car.received), list(car.car.motor_log), car.car.pose(car.now)

    assert await life(3) == await life(3)
    assert (await life(3))[0] != (await life(4))[0]


async def test_firmware_is_independent_of_time_step() -> None:
    seen = []
    for step in (0.001, 0.5):
        car = virtual()
        await car.write(opening(2))
        for _ in range(math.ceil(20 / step)):
            await car.wait(step)
        await car.wait(21 - car.now)
        seen.append((bytes(car.received), car.truth))
    assert seen[0] == seen[1]
