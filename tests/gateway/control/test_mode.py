"""Which mode the car is in: every way from assumed to confirmed, to contradicted and back."""

import pytest

from gateway.control.mode import CONTRADICTING_FRAMES, ModeTruth, Verdict
from gateway.protocol.decode import SILENCE_S, Decoder, Sensors
from gateway.protocol.profile import parse_platform
from gateway.protocol.values import Mode

ASSUMED, CONFIRMED, CONTRADICTED = Verdict.ASSUMED, Verdict.CONFIRMED, Verdict.CONTRADICTED
SHAPES = {
    Mode.MANUAL: b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#",
    Mode.TRACKING: b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#",
    Mode.LIGHT_SEEKING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM10#",
    Mode.FOLLOWING: b"$4WD,CSB120,PV8.3,GS000,LF0000,HW01,GM00$",
}
EITHER = b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM00"
"""Before a silence: light seeking whose `#` is late, or following, which has none."""
SILENT = (Mode.REMOTE_CONTROL, Mode.OBSTACLE_AVOIDANCE, Mode.COLOR_LED)
BLOCK_S = 2.5


def reading(shape: bytes, at: float) -> Sensors:
    decoder = Decoder()
    event = (decoder.feed(shape, at) + decoder.tick(at + SILENCE_S))[0]
    assert isinstance(event, Sensors)
    return event


def asked(mode: Mode, at: float = 0.0) -> ModeTruth:
    truth = ModeTruth(parse_platform("arduino"))
    truth.ask(mode, now=at, block_s=BLOCK_S)
    return truth


def test_before_anything_is_asked_nothing_is_said() -> None:
    truth = ModeTruth(parse_platform("arduino"))
    truth.silent(now=100.0, blocked_until=0.0, fan=False)
    truth.heard(reading(SHAPES[Mode.TRACKING], 1.0))
    assert (truth.asked, truth.inferred, truth.verdict) == (None, Mode.TRACKING, ASSUMED)


@pytest.mark.parametrize("mode", SHAPES)
def test_its_own_shape_confirms_a_mode(mode: Mode) -> None:
    truth = asked(mode)
    assert (truth.verdict, truth.evidence) == (ASSUMED, f"{mode} was asked, nothing heard since")
    truth.heard(reading(SHAPES[mode], BLOCK_S + 1))
    assert (truth.verdict, truth.inferred) == (CONFIRMED, mode)
    assert (truth.evidence, truth.evidence_at) == (f"a reading with the shape of {mode}", BLOCK_S + 1)


def test_a_shape_of_two_modes_confirms_neither_and_speaks_against_neither() -> None:
    for mode in (Mode.LIGHT_SEEKING, Mode.FOLLOWING):
        truth = asked(mode)
        for number in range(2 * CONTRADICTING_FRAMES):
            truth.heard(reading(EITHER, BLOCK_S + number))
        assert truth.verdict is ASSUMED
        assert set(truth.candidates) == {Mode.LIGHT_SEEKING, Mode.FOLLOWING}


@pytest.mark.parametrize("mode", [mode for mode in SHAPES if mode is not Mode.TRACKING] + list(SILENT))
def test_three_readings_running_of_another_mode_contradict(mode: Mode) -> None:
    truth = asked(mode)
    for number in range(1, CONTRADICTING_FRAMES + 1):
        assert truth.verdict is ASSUMED
        truth.heard(reading(SHAPES[Mode.TRACKING], BLOCK_S + number))
    assert (truth.verdict, truth.inferred) == (CONTRADICTED, Mode.TRACKING)
    assert truth.evidence == "3 readings running with the shape of tracking"
    if mode in SHAPES:
        truth.heard(reading(SHAPES[mode], BLOCK_S + 9))
        assert truth.verdict is CONFIRMED, "it is believed again"


def test_two_of_another_mode_are_forgotten_when_its_own_comes() -> None:
    truth = asked(Mode.TRACKING)
    for number, mode in enumerate([Mode.MANUAL, Mode.MANUAL, Mode.TRACKING, Mode.MANUAL, Mode.MANUAL]):
        truth.heard(reading(SHAPES[mode], BLOCK_S + number))
    assert truth.verdict is CONFIRMED


def test_readings_that_were_under_way_while_it_opens_do_not_count() -> None:
    truth = asked(Mode.TRACKING)
    for number in range(20):
        truth.heard(reading(SHAPES[Mode.MANUAL], BLOCK_S * number / 20))
    assert truth.verdict is ASSUMED


@pytest.mark.parametrize(
    ("mode", "limit_s"),
    [(Mode.MANUAL, 3.0), (Mode.TRACKING, 1.0), (Mode.LIGHT_SEEKING, 1.0), (Mode.FOLLOWING, 1.0)],
)
def test_silence_contradicts_a_mode_that_talks(mode: Mode, limit_s: float) -> None:
    truth = asked(mode)
    truth.silent(now=BLOCK_S + limit_s - 0.01, blocked_until=0.0, fan=False)
    assert truth.verdict is ASSUMED, "its opening is a block that is known"
    truth.heard(reading(SHAPES[mode], BLOCK_S + 1))
    truth.silent(now=BLOCK_S + 1 + limit_s, blocked_until=0.0, fan=False)
    assert truth.verdict is CONFIRMED
    truth.silent(now=BLOCK_S + 5 + limit_s, blocked_until=BLOCK_S + 5.1, fan=False)
    assert truth.verdict is CONFIRMED, "a block of ours"
    truth.silent(now=BLOCK_S + 99, blocked_until=0.0, fan=True)
    assert truth.verdict is CONFIRMED, "a fan that runs"
    truth.silent(now=BLOCK_S + 1.01 + limit_s, blocked_until=0.0, fan=False)
    assert truth.verdict is CONTRADICTED
    assert truth.evidence == f"silent for {limit_s:.1f} s, {mode} reports at least every {limit_s:g} s"
    truth.heard(reading(SHAPES[mode], BLOCK_S + 20))
    assert truth.verdict is CONFIRMED


@pytest.mark.parametrize("mode", SILENT)
def test_silence_never_confirms(mode: Mode) -> None:
    truth = asked(mode)
    truth.silent(now=12.0, blocked_until=0.0, fan=False)
    assert (truth.verdict, truth.evidence) == (ASSUMED, "silent for 12 s, as expected")
    assert truth.silence_limit(fan=False) is None
    truth.silent(now=1e6, blocked_until=0.0, fan=False)
    assert truth.verdict is ASSUMED


def test_asked_again_for_manual_a_confirmed_car_stays_confirmed() -> None:
    truth = asked(Mode.MANUAL)
    truth.heard(reading(SHAPES[Mode.MANUAL], 4.0))
    truth.ask(Mode.MANUAL, now=5.0, block_s=1.0)
    assert truth.verdict is CONFIRMED
    truth.ask(Mode.TRACKING, now=6.0, block_s=BLOCK_S)
    assert (truth.asked, truth.verdict) == (Mode.TRACKING, ASSUMED)


def test_a_lost_link_forgets() -> None:
    truth = asked(Mode.TRACKING)
    truth.heard(reading(SHAPES[Mode.TRACKING], 4.0))
    truth.forget()
    assert (truth.asked, truth.inferred, truth.verdict, truth.candidates) == (None, None, ASSUMED, ())
    assert (truth.evidence, truth.evidence_at) == ("the link was lost", None)
