"""The table of platforms, the times, and the measured fields of a frame."""

import re

import pytest

from gateway.protocol.decoder import Decoder, Sensors
from gateway.protocol.enums import Mode, SpeedStep
from gateway.protocol.frames import ArmSet, parse_sent
from gateway.protocol.modes import MODES, candidate_modes, only_candidate
from gateway.protocol.platform_name import OPTION_WORDS, Platform
from gateway.protocol.platforms import StopStyle, parse_platform
from gateway.protocol.timing import FRAME_S, LONGEST_BLOCK_S, RECOVERY_SILENCE_S
from tests.support.vectors import ids, rows, wire

PLATFORMS, PLACEHOLDERS, BLOCKS, TURNS = rows("platforms"), rows("placeholders"), rows("blocks"), rows("turns")
SPEED, CONTRADICTIONS = rows("speed"), rows("contradictions")
ALL = "range battery grayscale line obstacle light"


def sensors(raw: bytes, ended: str) -> Sensors:
    decoder = Decoder()
    event = (decoder.feed(raw + (b"$" if ended == "$" else b""), 1.0) + decoder.tick(2.0))[0]
    assert isinstance(event, Sensors)
    assert (event.terminated, event.by_silence) == (ended == "#", ended == "silence")
    return event


@pytest.mark.parametrize("platform", Platform)
@pytest.mark.parametrize("row", PLATFORMS, ids=ids(PLATFORMS))
def test_what_a_platform_knows(row: dict[str, str], platform: Platform) -> None:
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


def test_the_longest_block_outside_avoidance() -> None:
    profile = parse_platform("unknown+arm")
    frames = [parse_sent(wire(row["bytes"])) for row in PLATFORMS]
    assert max(profile.block_s(frame) for frame in frames if frame) == pytest.approx(LONGEST_BLOCK_S)
    assert MODES[Mode.FOLLOWING].open_s == LONGEST_BLOCK_S == 3.5
    assert profile.block_s(ArmSet((0,) * 6)) > FRAME_S


@pytest.mark.parametrize("row", TURNS, ids=ids(TURNS))
def test_the_turn_and_rate_of_each_mode(row: dict[str, str]) -> None:
    profile, mode = parse_platform("arduino"), Mode(row["mode"])
    assert profile.mode_turn_s(mode) == float(row["seconds"])
    assert MODES[mode].rate_hz == float(row["hz"])
    assert (mode in profile.silent_modes) is (float(row["hz"]) == 0)


def test_every_mode_has_a_row_and_a_turn() -> None:
    assert {row["mode"] for row in TURNS} == set(MODES) == set(Mode)
    assert len({row.digit for row in MODES.values()}) == len(MODES)


def test_recovery_waits_longer_than_any_mode_opens() -> None:
    assert RECOVERY_SILENCE_S == 3.7
    assert all(row.open_s + FRAME_S < RECOVERY_SILENCE_S for row in MODES.values())


@pytest.mark.parametrize("platform", Platform)
@pytest.mark.parametrize("row", PLACEHOLDERS, ids=ids(PLACEHOLDERS))
def test_what_is_measured(row: dict[str, str], platform: Platform) -> None:
    event, profile = sensors(wire(row["bytes"]), row["ended"]), parse_platform(platform)
    assert candidate_modes(event) == tuple(map(Mode, row["candidates"].split()))
    assert only_candidate(event) == (candidate_modes(event)[0] if len(candidate_modes(event)) == 1 else None)
    assert profile.measured(event) == set((ALL if row[platform] == "all" else row[platform]).split())
    obstacle = None if row["obstacle"] == "-" else tuple(bit == "1" for bit in row["obstacle"])
    assert profile.obstacle(event) == obstacle


def test_a_confirmed_mode_chooses_among_candidates_and_decides_nothing_else() -> None:
    profile = parse_platform("arduino")
    either = sensors(b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM00", "silence")
    assert profile.measured(either, Mode.FOLLOWING) == {"obstacle"}
    assert profile.obstacle(either, Mode.FOLLOWING) == (True, True)
    assert profile.measured(either, Mode.LIGHT_SEEKING) == {"light"}
    assert profile.obstacle(either, Mode.LIGHT_SEEKING) is None
    assert profile.measured(either, Mode.MANUAL) == set()
    tracking = sensors(b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#", "#")
    assert profile.measured(tracking, Mode.MANUAL) == {"line"}, "the frame's text is the evidence"


@pytest.mark.parametrize("platform", ["arduino", "stm32", "raspberry_pi"])
@pytest.mark.parametrize("row", CONTRADICTIONS, ids=ids(CONTRADICTIONS))
def test_what_speaks_against_a_platform(row: dict[str, str], platform: str) -> None:
    event = sensors(wire(row["bytes"]), "#")
    expected = [words for words in row[platform].split(", ") if words]
    found = parse_platform(platform).contradictions(event)
    assert len(found) == len(expected)
    assert all(words in text for words, text in zip(expected, found, strict=True))
    assert parse_platform("unknown").contradictions(event) == ()


@pytest.mark.parametrize("row", SPEED, ids=ids(SPEED))
def test_speed_is_counted_in_steps(row: dict[str, str]) -> None:
    model = parse_platform(row["platform"]).speed
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
        ("stm32", 7, StopStyle.MODE_FRAME, False, "drive whistle speed servo fan light servo_deg led mode"),
        (
            "raspberry_pi",
            1,
            StopStyle.RASPBERRY_PI,
            False,
            "drive whistle speed servo fan light servo_deg led servo_vertical servo_horizontal",
        ),
        ("unknown", 1, StopStyle.UNKNOWN, False, "drive whistle speed servo fan light"),
    ],
)
def test_a_platform_at_a_glance(platform: str, modes: int, stop: StopStyle, observed: bool, capabilities: str) -> None:
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
def test_a_platform_that_is_none_is_refused_with_the_words_allowed(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        parse_platform(text)


def test_a_platform_in_any_case_is_known() -> None:
    assert parse_platform("Arduino").name == "arduino"
