"""Tests of the platform detector: readings contradict a configured platform, or settle the platform of `auto`."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.drivers.yahboom.estimate.platform import EVIDENCE_FRAMES, OTHER_PROGRAM_FRAMES, PlatformDetector
from gateway.drivers.yahboom.protocol.frame_splitter import MISSING_END_SILENCE_S, FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.wire_events import Event
from gateway.sim.model.factory import build
from schemas.words import Mode
from tests.support.truth import WORLDS, frame_of
from tests.support.vectors import ids, rows, wire

CASES = rows("platform_truth")
ARDUINO = "$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#"
PI = "$4WD,CSB57,PV8.4,GS0,LF1011,HW01,GM10#"
TRACKING = "$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#"
ARM = "$4WD,J190,J290,J390,J490,J590,J690#"


def event_of(text: str) -> Event:
    decoder = FrameSplitter()
    return (decoder.feed(wire(text), 1.0) + decoder.flush(1.0 + MISSING_END_SILENCE_S))[0]


def hear(truth: PlatformDetector, *frames: str) -> list[str]:
    return [words for frame in frames for words in truth.on_event(event_of(frame))]


@pytest.mark.parametrize("row", CASES, ids=ids(CASES))
def test_platform_detection_vectors(row: dict[str, str]) -> None:
    """Vectors: frames in order with their counts, the contradictions that follow, and the platform of `auto`."""
    auto = PlatformDetector(parse_platform("unknown"), auto=True)
    told = {name: PlatformDetector(parse_platform(name)) for name in ("arduino", "stm32", "raspberry_pi", "unknown")}
    events: dict[str, list[str]] = {name: [] for name in told}
    for part in row["heard"].split(" "):
        count, _, frame = part.partition("x")
        for _ in range(int(count)):
            hear(auto, frame)
            for name, truth in told.items():
                events[name] += hear(truth, frame)
    assert auto.profile.name == row["auto"]
    assert row["evidence"] in auto.evidence[0]
    for name, truth in told.items():
        expected = [words for words in row.get(name, "").split("; ") if words]
        assert len(truth.contradictions) == len(expected), truth.contradictions
        assert all(words in " ".join(truth.contradictions) for words in expected)
        assert set(truth.contradictions) <= set(truth.evidence)
        assert set(truth.contradictions) <= set(events[name])
        assert len(events[name]) == len(set(events[name])), "each is told once"
        assert truth.profile.name == name, "what was told is kept"


def test_contradiction_is_told_at_start_and_end() -> None:
    truth = PlatformDetector(parse_platform("stm32"))
    assert not hear(truth, PI, PI)
    assert hear(truth, PI) == list(truth.contradictions) != []
    assert not hear(truth, PI, PI, ARDUINO, ARDUINO)
    assert truth.contradictions
    assert not hear(truth, ARDUINO)
    assert not truth.contradictions


def test_readings_of_another_mode_say_nothing_of_mode_0() -> None:
    truth = PlatformDetector(parse_platform("arduino"))
    hear(truth, PI, PI, *[TRACKING] * 30)
    assert hear(truth, PI)


@given(
    st.lists(
        st.tuples(
            st.integers(EVIDENCE_FRAMES, 9), st.sampled_from([PI, TRACKING, "$4WD,CSB57,PV7.9,GS3,LF1011,HW01,GM10#"])
        )
    )
)
def test_one_damaged_frame_never_contradicts(bursts: list[tuple[int, str]]) -> None:
    truth = PlatformDetector(parse_platform("arduino"))
    auto = PlatformDetector(parse_platform("unknown"), auto=True)
    hear(auto, *[ARDUINO] * EVIDENCE_FRAMES)
    for good, damaged in bursts:
        assert not hear(truth, *[ARDUINO] * good, damaged)
        hear(auto, *[ARDUINO] * good, damaged)
    assert truth.evidence == ()
    assert auto.profile.name == "arduino"


@pytest.mark.parametrize("platform", ["arduino", "stm32", "raspberry_pi"])
def test_nothing_shows_a_named_platform(platform: str) -> None:
    """That a property of such cars was never observed is no evidence for the platform."""
    assert PlatformDetector(parse_platform(platform)).evidence == ()


def test_auto_adds_the_options_that_it_hears() -> None:
    truth = PlatformDetector(parse_platform("unknown"), auto=True)
    hear(truth, ARM, ARM, ARM)
    assert truth.profile.name == "unknown+arm"
    hear(truth, *[ARDUINO] * EVIDENCE_FRAMES)
    assert truth.profile.name == "arduino+arm"


def hear_raw(truth: PlatformDetector, *heads: str) -> list[str]:
    """Hear sensors frames with these first words, as a decoder of the profile's head reads them."""
    decoder = FrameSplitter(head=truth.profile.dialect.head)
    frames = [ARDUINO.replace("4WD", head).encode() for head in heads]
    return [words for frame in frames for event in decoder.feed(frame, 1.0) for words in truth.on_event(event)]


def test_auto_takes_another_head_from_three_readings() -> None:
    truth = PlatformDetector(parse_platform("unknown+text"), auto=True)
    hear_raw(truth, "BALA", "BALA", "4WD", "BALA", "BALA", "CART", "BALA", "BALA")
    assert truth.profile.name == "unknown+text", "never three running"
    truth.begin_link()
    assert hear_raw(truth, *["BALA"] * EVIDENCE_FRAMES) == []
    assert truth.profile.name == "unknown+head=BALA+text"
    hear_raw(truth, *["BALA"] * EVIDENCE_FRAMES)
    assert truth.profile.name == "arduino+head=BALA+text"
    hear_raw(truth, *["4WD"] * OTHER_PROGRAM_FRAMES)
    assert truth.profile.dialect.head == "4WD", "another program on the same link"


@pytest.mark.parametrize("auto", [False, True])
def test_damaged_frames_do_not_change_head(*, auto: bool) -> None:
    """A link that loses every second frame's `4` made the gateway send `$WD,MODE00#`, which no car knows."""
    truth = PlatformDetector(parse_platform("unknown" if auto else "arduino"), auto=auto)
    for count in range(1, OTHER_PROGRAM_FRAMES):
        hear_raw(truth, "4WD", *["WD"] * count)
        assert truth.profile.dialect.head == "4WD"
    unsettled = FrameSplitter().feed(ARDUINO.encode(), 1.0)
    for event in unsettled:
        truth.on_event(event, counts=False)
    hear_raw(truth, "WD")
    assert truth.profile.dialect.head == "4WD"


def test_bytes_know_the_head_better_than_an_option() -> None:
    truth = PlatformDetector(parse_platform("unknown+head=CART"), auto=True)
    hear_raw(truth, *["BALA"] * EVIDENCE_FRAMES)
    assert truth.profile.name == "unknown+head=BALA"


def test_unexpected_head_is_taken_and_told_once() -> None:
    truth = PlatformDetector(parse_platform("arduino+arm+head=CART"))
    (words,) = hear_raw(truth, *["BALA"] * 9)
    assert "arduino+arm+head=BALA" in words
    assert truth.profile.name == "arduino+arm+head=BALA"
    assert truth.contradictions == (words,)
    assert not truth.doubted, "everything else is as it was named"


def test_car_that_is_neither_is_treated_as_unknown() -> None:
    truth = PlatformDetector(parse_platform("unknown"), auto=True)
    hear(truth, *[ARDUINO] * EVIDENCE_FRAMES)
    assert truth.profile.name == "arduino"
    hear(truth, *[PI] * EVIDENCE_FRAMES)
    assert truth.profile.name == "unknown"
    assert truth.evidence[0].startswith("both ")
    hear(truth, *[ARDUINO] * 9, *[PI] * 9)
    assert truth.profile.name == "unknown", "it does not flip"


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("platform", ["arduino", "stm32", "raspberry_pi"])
def test_simulated_cars_are_detected_without_contradiction(platform: str, world: str) -> None:
    for mode in Mode:
        car = build(platform, WORLDS[world](), 0, random.Random(3), options=frozenset({"arm"}))
        told = PlatformDetector(parse_platform(f"{platform}+arm"))
        auto = PlatformDetector(parse_platform("unknown"), auto=True)
        decoder = FrameSplitter()
        car.feed(frame_of(mode), 0.0)
        for tenth in range(300):
            for at, data in car.advance(tenth / 10):
                for event in decoder.feed(data, at):
                    assert not told.on_event(event)
                    auto.on_event(event)
        silent = platform != "raspberry_pi" and mode in parse_platform(platform).silent_modes
        running = mode is not Mode.MANUAL and platform != "raspberry_pi"
        # Bytes of an stm32 are those of an arduino, except over a dark floor: its converter has 12 bits.
        kinds = {"unknown"} if silent else {platform, "arduino"} if platform == "stm32" else {platform}
        assert auto.profile.name in {kind + ("" if running else "+arm") for kind in kinds}
