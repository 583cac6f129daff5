"""Tests of the mode estimate: every way from assumed to confirmed, to contradicted and back."""

import pytest
from msgspec.structs import replace

from gateway.drivers.yahboom.estimate.learned import Learned, Rhythm
from gateway.drivers.yahboom.estimate.mode import CONTRADICTING_FRAMES, ModeEstimator
from gateway.drivers.yahboom.protocol.frame_splitter import MISSING_END_SILENCE_S, FrameSplitter
from gateway.drivers.yahboom.protocol.modes import only_candidate
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.sensors import Sensors
from schemas.words import Mode, Verdict

ASSUMED, CONFIRMED, CONTRADICTED = Verdict.ASSUMED, Verdict.CONFIRMED, Verdict.CONTRADICTED
SHAPES = {
    Mode.MANUAL: b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#",
    Mode.TRACKING: b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#",
    Mode.LIGHT_SEEKING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM10#",
    Mode.FOLLOWING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW01,GM00$",
}
EITHER = b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM00"
"""Before a silence, this is light seeking with a late `#`, or following, which sends none."""
SILENT = (Mode.REMOTE_CONTROL, Mode.OBSTACLE_AVOIDANCE, Mode.COLOR_LED)
BLOCK_S = 2.5
SETTLED_S = {mode: BLOCK_S + (0.1 if mode is Mode.MANUAL else 1.0) for mode in Mode}
"""Time until a mode is open: the turn of the previous mode, and the block."""


def reading(shape: bytes, at: float) -> Sensors:
    decoder = FrameSplitter()
    event = (decoder.feed(shape, at) + decoder.flush(at + MISSING_END_SILENCE_S))[0]
    assert isinstance(event, Sensors)
    return event


def estimator(platform: str = "arduino", *reporting: Mode) -> ModeEstimator:
    """Return the estimator of a car that reports once a second in mode 0, and in these modes."""
    learned = Learned(reporting=set(reporting))
    learned.add_interval(1.0, echo=True)
    return ModeEstimator(parse_platform(platform), learned)


def asked(mode: Mode) -> ModeEstimator:
    """Return the estimate of a car that reported in mode 0 or in tracking, and got the command for `mode` at 0.0."""
    truth = estimator("arduino", *SHAPES)
    before = Mode.TRACKING if mode is Mode.MANUAL else Mode.MANUAL
    truth.on_mode_sent(before, now=-10.0, block_s=1.0)
    truth.on_reading(reading(SHAPES[before], -0.1))
    assert truth.confirmed is before
    truth.on_mode_sent(mode, now=0.0, block_s=BLOCK_S)
    assert truth.verdict is ASSUMED
    assert f"mode {mode} " in truth.evidence
    return truth


def test_before_anything_is_asked_nothing_is_said() -> None:
    truth = estimator()
    truth.on_silence(now=100.0, fan=False)
    truth.on_reading(reading(SHAPES[Mode.TRACKING], 1.0))
    assert (truth.asked, truth.inferred, truth.verdict, truth.confirmed) == (None, Mode.TRACKING, ASSUMED, None)
    assert truth.silence_limit(fan=False) is None


@pytest.mark.parametrize("mode", SHAPES)
def test_matching_reading_confirms_mode(mode: Mode) -> None:
    truth = asked(mode)
    truth.on_reading(reading(SHAPES[mode], 3.0))
    assert (truth.verdict, truth.inferred, truth.confirmed, truth.candidates) == (CONFIRMED, mode, mode, (mode,))
    assert f"mode {mode}" in truth.evidence
    assert truth.evidence_at == 3.0


def test_ambiguous_shape_neither_confirms_nor_contradicts() -> None:
    for mode in (Mode.LIGHT_SEEKING, Mode.FOLLOWING):
        truth = asked(mode)
        for number in range(2 * CONTRADICTING_FRAMES):
            truth.on_reading(reading(EITHER, SETTLED_S[mode] + number))
        assert (truth.verdict, truth.inferred) == (ASSUMED, None)
        assert set(truth.candidates) == {Mode.LIGHT_SEEKING, Mode.FOLLOWING}


@pytest.mark.parametrize("mode", [mode for mode in SHAPES if mode is not Mode.TRACKING] + list(SILENT))
def test_three_readings_running_of_another_mode_contradict(mode: Mode) -> None:
    truth = asked(mode)
    for number in range(1, CONTRADICTING_FRAMES + 1):
        assert truth.verdict is ASSUMED
        truth.on_reading(reading(SHAPES[Mode.TRACKING], 4.0 + number))
    assert (truth.verdict, truth.inferred, truth.confirmed) == (CONTRADICTED, Mode.TRACKING, None)
    assert truth.evidence == "3 consecutive readings as in mode tracking"
    if mode in SHAPES:
        truth.on_reading(reading(SHAPES[mode], 9.0))
        assert truth.verdict is CONFIRMED, "it is believed again"


def test_two_of_another_mode_are_forgotten_when_its_own_comes() -> None:
    truth = asked(Mode.TRACKING)
    for number, mode in enumerate([Mode.MANUAL, Mode.MANUAL, Mode.TRACKING, Mode.MANUAL, Mode.MANUAL]):
        truth.on_reading(reading(SHAPES[mode], 4.0 + number))
    assert truth.verdict is CONFIRMED


def test_damaged_reading_of_another_mode_does_not_confirm() -> None:
    """A tracking frame with one wrong digit has the shape of mode 0, because there is no checksum."""
    truth = asked(Mode.MANUAL)
    damaged = reading(b"$4WD,CSB0,PV8,GS0,LF1001,HW01,GM00#", 5.0)
    assert only_candidate(damaged) is Mode.MANUAL
    for number in range(20):
        event = damaged if number % 5 == 2 else reading(SHAPES[Mode.TRACKING], 5.0)
        truth.on_reading(replace(event, at=5.0 + number / 27))
        assert truth.verdict is (ASSUMED if number < 5 else CONTRADICTED), number
    for number in range(CONTRADICTING_FRAMES):
        assert truth.verdict is CONTRADICTED
        truth.on_reading(replace(damaged, at=6.0 + number / 27))
    assert truth.verdict is CONFIRMED, "three running are not damaged"


def test_readings_under_way_during_mode_change_do_not_count() -> None:
    truth = asked(Mode.TRACKING)
    for number in range(20):
        truth.on_reading(reading(SHAPES[Mode.MANUAL], SETTLED_S[Mode.TRACKING] * number / 20))
    assert truth.verdict is ASSUMED


@pytest.mark.parametrize(
    ("mode", "limit_s"),
    [(Mode.MANUAL, 3.0), (Mode.TRACKING, 1.0), (Mode.LIGHT_SEEKING, 1.0), (Mode.FOLLOWING, 1.0)],
)
def test_silence_contradicts_a_mode_that_talks(mode: Mode, limit_s: float) -> None:
    truth = asked(mode)
    truth.on_silence(now=SETTLED_S[mode] + limit_s - 0.01, fan=False)
    assert truth.verdict is ASSUMED, "its opening is a block that is known"
    truth.on_reading(reading(SHAPES[mode], 10.0))
    truth.on_silence(now=10.0 + limit_s, fan=False)
    assert truth.verdict is CONFIRMED
    truth.on_silence(now=10.01 + limit_s, fan=False)
    assert truth.verdict is CONTRADICTED
    assert f"{limit_s:.1f} s, " in truth.evidence
    assert f" {limit_s:g} s" in truth.evidence
    assert f"mode {mode} " in truth.evidence
    truth.on_silence(now=13.5, fan=False)
    assert (truth.candidates, truth.inferred) == (SILENT, None)
    truth.on_reading(reading(SHAPES[mode], 20.0))
    assert truth.verdict is CONFIRMED


def test_blocks_of_ours_explain_as_much_silence_as_they_last() -> None:
    truth = asked(Mode.MANUAL)
    truth.on_reading(reading(SHAPES[Mode.MANUAL], 10.0))
    for at, block_s in ((8.0, 5.0), (10.1, 0.3), (10.5, 0.65), (11.2, 0.06), (11.3, 0.06)):
        truth.on_written(block_s, now=at)
    truth.on_silence(now=13.94, fan=False)
    assert truth.verdict is CONFIRMED
    assert truth.unheard_s(13.94) == pytest.approx(2.99)
    truth.on_silence(now=13.96, fan=False)
    assert truth.verdict is CONTRADICTED, "a block before the reading is over, and a motion is none"


def test_frame_may_be_obeyed_after_reading_under_way() -> None:
    truth = asked(Mode.MANUAL)
    truth.on_written(0.65, now=9.2)
    truth.on_reading(reading(SHAPES[Mode.MANUAL], 10.0))
    assert truth.unheard_s(11.0) == pytest.approx(0.35)


def test_no_frames_however_many_explain_a_silence_for_ever() -> None:
    truth = asked(Mode.MANUAL)
    for number in range(1000):
        truth.on_written(0.3, now=10.0 + 0.3 * number)
        truth.on_silence(now=10.0 + 0.3 * number, fan=False)
    assert truth.verdict is CONTRADICTED


def test_fan_silences_car_and_confirmation_fades() -> None:
    truth = asked(Mode.MANUAL)
    truth.on_reading(reading(SHAPES[Mode.MANUAL], 10.0))
    truth.on_silence(now=13.0, fan=True)
    assert truth.verdict is CONFIRMED
    truth.on_silence(now=70.0, fan=True)
    assert truth.verdict is ASSUMED
    assert "60 s, " in truth.evidence
    assert "fan runs" in truth.evidence
    assert (truth.candidates, truth.inferred) == (tuple(Mode), None)
    truth.on_silence(now=73.0, fan=False)
    assert truth.verdict is ASSUMED, "the clock began when the fan was off"
    truth.on_silence(now=73.1, fan=False)
    assert truth.verdict is CONTRADICTED


def test_mode_without_own_readings_is_contradicted_by_silence() -> None:
    """Mode 0 reports once a second, so three of its readings would take three times as long."""
    truth = asked(Mode.TRACKING)
    truth.on_reading(reading(SHAPES[Mode.TRACKING], 9.9))
    truth.on_reading(reading(SHAPES[Mode.MANUAL], 10.8))
    truth.on_silence(now=10.85, fan=False)
    assert truth.verdict is CONFIRMED
    truth.on_silence(now=11.0, fan=False)
    assert truth.verdict is CONTRADICTED
    assert "mode tracking for 1.1 s, " in truth.evidence
    assert truth.evidence.endswith("mode manual")


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING])
def test_silence_in_never_reported_mode_shows_nothing(mode: Mode) -> None:
    truth = estimator()
    truth.on_mode_sent(mode, now=0.0, block_s=BLOCK_S)
    truth.on_silence(now=60.0, fan=False)
    assert truth.verdict is ASSUMED
    assert truth.silence_limit(fan=False) is None
    truth.on_reading(reading(SHAPES[mode], 61.0))
    assert truth.verdict is CONFIRMED
    truth.on_silence(now=63.0, fan=False)
    assert truth.verdict is CONTRADICTED, "it does report there, and has stopped"


@pytest.mark.parametrize(("interval_s", "limit_s"), [(0.3, 3.0), (1.25, 3.0), (1.5, 3.25), (3.0, 4.75)])
def test_silence_that_contradicts_mode_0_is_learned(interval_s: float, limit_s: float) -> None:
    truth = estimator()
    truth.learned.echo = Rhythm()
    truth.learned.add_interval(interval_s, echo=True)
    assert truth.manual_silence_s == pytest.approx(limit_s)


@pytest.mark.parametrize("mode", SILENT)
def test_silence_never_confirms(mode: Mode) -> None:
    truth = asked(mode)
    truth.on_silence(now=3.4, fan=False)
    assert f"mode {mode} " in truth.evidence
    truth.on_silence(now=12.0, fan=False)
    assert (truth.verdict, truth.evidence) == (ASSUMED, "silent for 12 s, as expected")
    assert (truth.candidates, truth.inferred) == (SILENT, None)
    assert truth.silence_limit(fan=False) is None
    truth.on_silence(now=1e6, fan=False)
    assert truth.verdict is ASSUMED


def test_stray_readings_in_silent_mode_are_forgotten() -> None:
    truth = asked(Mode.COLOR_LED)
    for at in (10.0, 11.0, 20.0, 21.0):
        truth.on_reading(reading(SHAPES[Mode.MANUAL], at))
        truth.on_silence(now=at + 1, fan=False)
        truth.on_silence(now=at + 4, fan=False)
    assert truth.verdict is ASSUMED
    assert truth.evidence == "silent for 4 s, as expected"


def test_asked_again_for_manual_a_confirmed_car_stays_confirmed() -> None:
    truth = asked(Mode.MANUAL)
    truth.on_reading(reading(SHAPES[Mode.MANUAL], 4.0))
    truth.on_mode_sent(Mode.MANUAL, now=5.0, block_s=1.0)
    assert truth.verdict is CONFIRMED
    truth.on_mode_sent(Mode.TRACKING, now=6.0, block_s=BLOCK_S)
    assert (truth.asked, truth.verdict) == (Mode.TRACKING, ASSUMED)


@pytest.mark.parametrize(
    ("before", "latest_s"), [(Mode.OBSTACLE_AVOIDANCE, 5.3), (Mode.COLOR_LED, 1.75), (Mode.TRACKING, 1.1), (None, 5.3)]
)
def test_new_mode_counts_after_old_turn_and_block(before: Mode | None, latest_s: float) -> None:
    truth = estimator()
    if before is not None:
        truth.on_mode_sent(before, now=0.0, block_s=BLOCK_S)
    truth.on_mode_sent(Mode.MANUAL, now=100.0, block_s=1.0)
    assert truth.unheard_s(100.0 + latest_s) == pytest.approx(0.0)
    truth.on_mode_sent(Mode.MANUAL, now=101.1, block_s=1.0)
    assert truth.unheard_s(101.0 + max(latest_s, 2.1)) == pytest.approx(0.0), "it waits for the one before"


@pytest.mark.parametrize(("platform", "fits"), [("raspberry_pi", ()), ("unknown", SILENT)])
def test_silence_of_car_without_silent_modes_is_no_mode(platform: str, fits: tuple[Mode, ...]) -> None:
    truth = estimator(platform)
    truth.on_mode_sent(Mode.MANUAL, now=0.0, block_s=0.0)
    truth.on_reading(reading(b"$4WD,CSB57,PV8.4,GS0,LF1011,HW01,GM10#", 5.0))
    assert truth.verdict is CONFIRMED
    truth.on_silence(now=8.1, fan=False)
    assert (truth.verdict, truth.candidates) == (CONTRADICTED, fits)
    assert ("program has ended" in truth.evidence) is (not fits)


def test_fan_of_a_raspberry_pi_car_silences_nothing() -> None:
    truth = estimator("raspberry_pi")
    truth.on_mode_sent(Mode.MANUAL, now=0.0, block_s=0.0)
    assert truth.silence_limit(fan=True) == 3.0


def test_lost_link_forgets() -> None:
    truth = asked(Mode.TRACKING)
    truth.on_reading(reading(SHAPES[Mode.TRACKING], 4.0))
    truth.forget()
    assert (truth.asked, truth.inferred, truth.verdict, truth.candidates) == (None, None, ASSUMED, ())
    assert "link was lost" in truth.evidence
    assert truth.evidence_at is None
