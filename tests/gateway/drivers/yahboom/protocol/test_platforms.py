"""The table of platforms, the times, and the measured fields of a frame."""

import re

import pytest

from gateway.control.driver import Rejected
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.frames import (
    ArmSet,
    Dialect,
    Frame,
    General,
    LoneHash,
    ModeClose,
    Ptz,
    parse_sent,
)
from gateway.drivers.yahboom.protocol.measurements import measured, verdict_of
from gateway.drivers.yahboom.protocol.modes import EVERY_MEASUREMENT, MODES, candidate_modes, only_candidate
from gateway.drivers.yahboom.protocol.platforms import SPEEDS, StopStyle, parse_platform
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.timing import FRAME_S, LONGEST_BLOCK_S, RECOVERY_SILENCE_S
from schemas.platform_name import OPTION_WORDS
from schemas.words import Light, Mode, Motion, Platform, SpeedStep
from tests.support.vectors import ids, rows, wire

PLATFORMS, PLACEHOLDERS, BLOCKS, TURNS = rows("platforms"), rows("placeholders"), rows("blocks"), rows("turns")
SPEED, CONTRADICTIONS = rows("speed"), rows("contradictions")
ALL = "range battery grayscale line obstacle light"


def sensors(raw: bytes, ended: str) -> Sensors:
    decoder = FrameSplitter()
    event = (decoder.feed(raw + (b"$" if ended == "$" else b""), 1.0) + decoder.flush(2.0))[0]
    assert isinstance(event, Sensors)
    assert (event.terminated, event.by_silence) == (ended == "#", ended == "silence")
    return event


@pytest.mark.parametrize("platform", Platform)
@pytest.mark.parametrize("row", PLATFORMS, ids=ids(PLATFORMS))
def test_platform_frame_refusals(row: dict[str, str], platform: Platform) -> None:
    frame = parse_sent(wire(row["bytes"]))
    assert frame is not None
    known, option = row[platform] == "yes", row[platform].startswith("+")
    words = parse_platform(platform).refusal(frame)
    assert (words is None) is known
    assert words is None or str(platform) in words or platform is Platform.UNKNOWN or "no car" in words
    assert (parse_platform(f"{platform}+arm").refusal(frame) is None) is (known or option)


@pytest.mark.parametrize("row", BLOCKS, ids=ids(BLOCKS))
def test_how_long_a_frame_blocks(row: dict[str, str]) -> None:
    frame = parse_sent(wire(row["bytes"]))
    assert frame is not None
    assert parse_platform(row["platform"]).block_s(frame) == pytest.approx(float(row["seconds"]))


def test_longest_block_outside_avoidance() -> None:
    profile = parse_platform("unknown+arm")
    frames = [parse_sent(wire(row["bytes"])) for row in PLATFORMS]
    assert max(profile.block_s(frame) for frame in frames if frame) == pytest.approx(LONGEST_BLOCK_S)
    assert MODES[Mode.FOLLOWING].open_s == LONGEST_BLOCK_S == 3.5
    assert profile.block_s(ArmSet((0,) * 6)) > FRAME_S


@pytest.mark.parametrize("row", TURNS, ids=ids(TURNS))
def test_mode_turn_and_report_rate(row: dict[str, str]) -> None:
    profile, mode = parse_platform("arduino"), Mode(row["mode"])
    assert profile.mode_turn_s(mode) == float(row["seconds"])
    assert MODES[mode].rate_hz == float(row["hz"])
    assert (mode in profile.silent_modes) is (float(row["hz"]) == 0)


def test_modes_have_row_and_turn() -> None:
    assert {row["mode"] for row in TURNS} == set(MODES) == set(Mode)
    assert len({row.digit for row in MODES.values()}) == len(MODES)


def test_recovery_waits_longer_than_any_mode_opens() -> None:
    assert RECOVERY_SILENCE_S == 3.7
    assert all(row.open_s + FRAME_S < RECOVERY_SILENCE_S for row in MODES.values())


@pytest.mark.parametrize("platform", Platform)
@pytest.mark.parametrize("row", PLACEHOLDERS, ids=ids(PLACEHOLDERS))
def test_platform_measured_values(row: dict[str, str], platform: Platform) -> None:
    event, profile = sensors(wire(row["bytes"]), row["ended"]), parse_platform(platform)
    assert candidate_modes(event) == tuple(map(Mode, row["candidates"].split()))
    assert only_candidate(event) == (candidate_modes(event)[0] if len(candidate_modes(event)) == 1 else None)
    assert profile.measured(event) == set((ALL if row[platform] == "all" else row[platform]).split())
    obstacle = None if row["obstacle"] == "-" else tuple(bit == "1" for bit in row["obstacle"])
    assert profile.obstacle(event) == (obstacle if "obstacle" in profile.measured(event) else None)


def test_confirmed_mode_chooses_among_candidates() -> None:
    profile = parse_platform("arduino")
    either = sensors(b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM00", "silence")
    assert profile.measured(either, Mode.FOLLOWING) == {"obstacle"}
    assert profile.obstacle(either, Mode.FOLLOWING) == (True, True)
    assert profile.measured(either, Mode.LIGHT_SEEKING) == {"light"}
    assert profile.obstacle(either, Mode.LIGHT_SEEKING) is None
    assert profile.measured(either, Mode.MANUAL) == set()
    avoiding = sensors(b"$4WD,CSB37,PV8.3,GS000,LF0000,HW00,GM00#", "#")
    assert profile.measured(avoiding, Mode.MANUAL) == {"range"}, "its filler is not of mode 0"
    report = sensors(b"$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#", "#")
    assert profile.measured(report, Mode.OBSTACLE_AVOIDANCE) == EVERY_MEASUREMENT
    tracking = sensors(b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#", "#")
    assert profile.measured(tracking, Mode.MANUAL) == {"line"}, "the frame's text is the evidence"


@pytest.mark.parametrize("platform", ["arduino", "stm32", "raspberry_pi"])
@pytest.mark.parametrize("row", CONTRADICTIONS, ids=ids(CONTRADICTIONS))
def test_platform_contradictions(row: dict[str, str], platform: str) -> None:
    event = sensors(wire(row["bytes"]), "#")
    expected = [words for words in row[platform].split(", ") if words]
    found = parse_platform(platform).contradictions(event)
    assert len(found) == len(expected)
    assert all(words in text for words, text in zip(expected, found, strict=True))
    assert parse_platform("unknown").contradictions(event) == ()


@pytest.mark.parametrize("row", SPEED, ids=ids(SPEED))
def test_speed_is_counted_in_steps(row: dict[str, str]) -> None:
    model = SPEEDS[Platform(row["platform"])]
    value, values = model.start, []
    for word in row["steps"].split():
        value = model.step(value, SpeedStep(word))
        values.append(value)
    assert values == [float(text) for text in row["values"].split()]
    assert model.fraction(value) == pytest.approx(float(row["fraction"]), abs=1e-4)


@pytest.mark.parametrize(
    ("platform", "modes", "stop", "observed", "capabilities"),
    [
        ("arduino", 7, StopStyle.MODE_FRAME, True, "drive whistle speed servo fan light servo_deg led mode"),
        ("stm32", 7, StopStyle.TIMER, False, "drive whistle speed servo fan light servo_deg mode"),
        (
            "raspberry_pi",
            1,
            StopStyle.GENERAL,
            False,
            "drive whistle speed servo fan light servo_deg led servo_vertical servo_horizontal",
        ),
        ("unknown", 1, StopStyle.GENERAL, False, "drive whistle speed servo fan light"),
    ],
)
def test_platform_profile_summary(
    platform: str, modes: int, stop: StopStyle, observed: bool, capabilities: str
) -> None:
    profile = parse_platform(platform)
    assert profile.name == platform
    assert len(profile.modes) == modes
    assert profile.stop_style is stop
    assert profile.observed is observed
    assert profile.capabilities == set(capabilities.split())
    both = parse_platform(f"{platform}+imu+arm")
    assert both.name == f"{platform}+arm+imu"
    assert both.capabilities == profile.capabilities | {"arm", "imu"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", 'Unknown platform "". There are arduino, stm32, raspberry_pi, unknown.'),
        ("esp32", 'Unknown platform "esp32". There are arduino, stm32, raspberry_pi, unknown.'),
        ("arduno", 'Unknown platform "arduno". Did you mean arduino?'),
        ("arduino imu", 'Unknown platform "arduino imu". Did you mean arduino?'),
        ("arduino+", f'Unknown option "+" of a platform. There are {OPTION_WORDS}.'),
        ("arduino+wings", f'Unknown option "+wings" of a platform. There are {OPTION_WORDS}.'),
        ("+arm", 'Unknown platform "". There are'),
    ],
)
def test_unknown_platform_is_refused_with_choices(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        parse_platform(text)


def test_platform_name_ignores_case() -> None:
    assert parse_platform("Arduino").name == "arduino"


def test_options_say_in_what_a_car_differs() -> None:
    plain, other = parse_platform("arduino"), parse_platform("arduino+fan_level+ptz_direct+text+no_readings+3s")
    assert (plain.fan_is_level, plain.ptz_direct) == (False, False)
    assert (other.fan_is_level, other.ptz_direct) == (True, True)
    assert (plain.has_readings, other.has_readings) == (True, False)
    assert (plain.cells, other.cells) == (2, 3)
    assert other.capabilities == plain.capabilities, "none is a part of the car"
    assert parse_platform(other.name) == other


def test_car_without_readings_measures_nothing_and_is_silent() -> None:
    profile = parse_platform("arduino+no_readings+arm")
    assert all(profile.measurable(mode) == set() for mode in Mode)
    assert profile.silent_modes == profile.modes


@pytest.mark.parametrize(
    ("platform", "text", "rejected"),
    [
        ("arduino", "PV12.00,GS1023", ""),
        ("arduino", "PV12.01,GS1024", "battery grayscale"),
        ("arduino+3s", "PV12.60,GS0", ""),
        ("stm32", "PV8.00,GS4095", ""),
        ("raspberry_pi", "PV8.00,GS1024", "grayscale"),
        ("unknown", "PV12.60,GS4095", "battery"),
    ],
)
def test_field_range_depends_on_platform(platform: str, text: str, rejected: str) -> None:
    event = sensors(f"$4WD,CSB57.24,{text},LF1011,HW01,GM10#".encode(), "#")
    profile, words = parse_platform(platform), rejected.split()
    assert profile.measured(event) == EVERY_MEASUREMENT - set(words)
    assert [reject.word for reject in profile.rejects(event)] == [{"battery": "PV"}.get(word, "GS") for word in words]


def test_field_out_of_every_range_is_rejected_once() -> None:
    event = sensors(b"$4WD,CSB1300,PV14,GS5000,LF1011,HW01,GM10#", "#")
    assert parse_platform("arduino").rejects(event) == event.rejects


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        (b"0.00", {"no_echo": True}),
        (b"0.004", {"no_echo": False, "range_m": 0.0001}),
        (b"57.24", {"no_echo": False, "range_m": 0.5724}),
        (b"1200", {"no_echo": False, "range_m": 12.0}),
    ],
)
def test_only_no_echo_is_published_without_a_distance(text: bytes, fields: dict[str, float]) -> None:
    event = sensors(b"$4WD,CSB%b,PV7.91,GS5,LF0000,HW00,GM00#" % text, "#")
    assert measured(event, parse_platform("arduino"), None)["sensor/range"] == fields


def test_stm32_constants_are_no_measurements() -> None:
    profile = parse_platform("stm32")
    assert profile.measured(sensors(b"$4WD,CSB57.24,PV7.91,GS0,LF0000,HW00,GM00#", "#")) == {"range", "battery"}
    assert profile.measured(sensors(b"$4WD,CSB57.24,PV7.91,GS0,LF0000,HW00,GM01#", "#")) == EVERY_MEASUREMENT


def test_stm32_is_never_blocked_and_modes_are_silent() -> None:
    profile = parse_platform("stm32")
    frames = [parse_sent(wire(row["bytes"])) for row in PLATFORMS]
    assert {profile.block_s(frame) for frame in frames if frame} == {FRAME_S}
    assert {profile.mode_turn_s(mode) for mode in Mode} == {FRAME_S}
    assert profile.silent_modes == set(Mode) - {Mode.MANUAL}


SPELLED: list[tuple[str, Frame, bytes]] = [
    ("arduino", General(Motion.STOP, light=Light.GREEN), b"$0,0,0,0,0,0,3,0,0#"),
    ("stm32", General(Motion.STOP, light=Light.GREEN), b"$0,0,0,0,0,0,4,0,0#"),
    ("stm32", General(Motion.FORWARD, light=Light.BLUE), b"$1,0,0,0,0,0,3,0,0#"),
    ("stm32", General(Motion.FORWARD, light=Light.RED), b"$1,0,0,0,0,0,2,0,0#"),
    ("stm32", General(Motion.FORWARD, fan=True), b"$1,0,0,0,0,0,0,1,0#"),
    ("stm32+head=BaLa", ModeClose(), b"$BaLa,MODE00#"),
    ("arduino+head=3WD", Ptz(30), b"$3WD,PTZ30#"),
    ("arduino+head=3WD+arm", ArmSet((1, 2, 3, 4, 5, 6)), b"$3WD,ServoJ11,J22,J33,J44,J55,J66#"),
    ("arduino+head=3WD", LoneHash(), b"#"),
]


@pytest.mark.parametrize(("platform", "frame", "data"), SPELLED)
def test_frame_encoding_depends_on_platform(platform: str, frame: Frame, data: bytes) -> None:
    profile = parse_platform(platform)
    assert profile.encode(frame) == data
    assert profile.parse_sent(data) == frame


def test_frame_of_other_head_is_not_parsed() -> None:
    assert parse_platform("arduino+head=BALA").parse_sent(b"$4WD,MODE00#") is None
    assert parse_platform("arduino").parse_sent(b"$BALA,MODE00#") is None
    assert parse_platform("arduino").parse_sent(b"$3WD,MODE00#") is None
    assert parse_platform("arduino").dialect == Dialect()


def test_readings_of_another_head_are_known_in_every_mode() -> None:
    profile = parse_platform("arduino+head=BALA")
    decoder = FrameSplitter(head=profile.dialect.head)
    texts = (b"CSB57.24,PV7.91,GS214,LF1011,HW01,GM10", b"CSB0,PV8,GS0,LF0110,HW00,GM00")
    events = decoder.feed(b"".join(b"$BALA,%b#" % text for text in texts), 1.0)
    events += decoder.feed(b"$BALA,CSB120,PV8.3,GS000,LF0000,HW10,GM00", 2.0) + decoder.flush(3.0)
    readings = [event for event in events if isinstance(event, Sensors)]
    modes = [(Mode.MANUAL,), (Mode.TRACKING,), (Mode.FOLLOWING,)]
    assert [candidate_modes(event) for event in readings] == modes
    assert decoder.feed(b"$BALA,J11,J22,J33,J44,J55,J66#", 4.0)[0].raw.startswith(b"$BALA,J1")


def test_readings_of_another_head_than_the_given_one_are_rejected() -> None:
    good = b"$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#"
    (event,) = FrameSplitter(head="BALA").feed(good, 1.0)
    assert isinstance(event, Rejected)
    assert event.detail == "'4WD' is not BALA"
    assert verdict_of(FrameSplitter(head="BALA").feed(b"BALA on\r\n" + b"$", 1.0)[0]) == "no_start"
