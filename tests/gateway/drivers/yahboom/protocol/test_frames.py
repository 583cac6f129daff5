"""Every frame to the car: encoding and parsing of the table's bytes, and rejected values."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.drivers.yahboom.protocol.frames import (
    ArmSet,
    ColorLed,
    EncodeError,
    Frame,
    General,
    LoneHash,
    ModeClose,
    ModeOpen,
    Ptz,
    encode,
    parse_sent,
)
from gateway.drivers.yahboom.protocol.modes import MODES
from schemas.words import Light, Mode, Motion, ServoAction, SpeedStep
from tests.support.vectors import ids, rows, wire

GENERAL, NAMED, REFUSED = rows("general"), rows("named"), rows("refused")


def general(row: dict[str, str]) -> General:
    return General(
        Motion(row["motion"]),
        whistle=row["whistle"] == "1",
        speed=None if row["speed"] == "-" else SpeedStep(row["speed"]),
        servo=None if row["servo"] == "-" else ServoAction(row["servo"]),
        sing=row["sing"] == "1",
        light=None if row["light"] == "-" else Light(row["light"]),
        fan=row["fan"] == "1",
    )


def named(row: dict[str, str]) -> Frame:
    values = row["values"].split()
    match row["frame"]:
        case "ptz":
            return Ptz(int(values[0]))
        case "color":
            return ColorLed(*map(int, values))
        case "open":
            return ModeOpen(Mode(values[0]))
        case "close":
            return ModeClose(Mode(values[0]))
        case "arm":
            return ArmSet(tuple(map(int, values)))
        case "reset":
            return LoneHash()
        case _:
            raise AssertionError(row)


@pytest.mark.parametrize("row", GENERAL, ids=ids(GENERAL))
def test_general_frame_of_the_table(row: dict[str, str]) -> None:
    assert encode(general(row)) == wire(row["bytes"])
    assert parse_sent(wire(row["bytes"])) == general(row)


@pytest.mark.parametrize("row", NAMED, ids=ids(NAMED))
def test_named_frame_of_the_table(row: dict[str, str]) -> None:
    assert encode(named(row)) == wire(row["bytes"])
    assert parse_sent(wire(row["bytes"])) == named(row)


@pytest.mark.parametrize("row", REFUSED, ids=ids(REFUSED))
def test_out_of_range_names_field_value_and_range(row: dict[str, str]) -> None:
    with pytest.raises(EncodeError) as refused:
        encode(named(row))
    assert row["words"] in str(refused.value)


@pytest.mark.parametrize("value", [True, 1.0, "1", None], ids=repr)
def test_only_whole_numbers_are_encoded(value: object) -> None:
    with pytest.raises(EncodeError, match="deg: "):
        encode(Ptz(value))  # type: ignore[arg-type]  # what an untyped caller may pass


def test_words_instead_of_members_are_refused_by_name() -> None:
    with pytest.raises(EncodeError, match=r"motion: 'fly', allowed are stop, forward"):
        encode(General("fly"))  # type: ignore[arg-type]  # what an untyped caller may pass


def test_every_word_of_the_enums_is_in_the_table() -> None:
    seen = {row[column] for row in GENERAL for column in ("motion", "speed", "servo", "light")}
    assert {*Motion, *SpeedStep, *ServoAction, *Light} <= seen
    assert {mode: MODES[mode].digit for mode in Mode} == {
        Mode.MANUAL: 0,
        Mode.REMOTE_CONTROL: 1,
        Mode.TRACKING: 2,
        Mode.OBSTACLE_AVOIDANCE: 3,
        Mode.COLOR_LED: 4,
        Mode.LIGHT_SEEKING: 5,
        Mode.FOLLOWING: 6,
    }


FRAMES = st.one_of(
    st.builds(General),
    st.builds(Ptz, st.integers(0, 180)),
    st.builds(ColorLed, *[st.integers(0, 255)] * 3),
    st.builds(ModeOpen, st.sampled_from([mode for mode in Mode if mode is not Mode.MANUAL])),
    st.builds(ModeClose),
    st.builds(ArmSet, st.tuples(*[st.integers(0, 180)] * 6)),
    st.builds(LoneHash),
)


@given(FRAMES)
def test_encode_and_parse_are_inverse(frame: Frame) -> None:
    data = encode(frame)
    assert parse_sent(data) == frame
    if isinstance(frame, General):
        assert len(data) == 19
    assert len(data) <= 20 or not isinstance(frame, (General, Ptz, ModeOpen, ModeClose, LoneHash))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"$",
        b"##",
        b"$1,0,0,0,0,0,0,0#",
        b"$1,0,0,0,0,0,0,0,0",
        b"$5,0,0,0,0,0,0,0,0#",
        b"$0,3,0,0,0,0,0,0,0#",
        b"$0,0,2,0,0,0,0,0,0#",
        b"$0,0,0,3,0,0,0,0,0#",
        b"$0,0,0,0,9,0,0,0,0#",
        b"$0,0,0,0,0,0,9,0,0#",
        b"$0,0,0,0,0,0,0,2,0#",
        b"$0,0,0,0,0,0,0,0,2#",
        b"$0,0,0,0,1,0,0,0,1#",
        b"$4WD,MODE01#",
        b"$4WD,MODE71#",
        b"$4WD,MODE22#",
        b"$4WD,PTZ181#",
        b"$4WD,PTZ#",
        b"$4WD,CLR256,CLG0,CLB0#",
        b"$4WD,CLR1,CLG2#",
        b"$4WD,J11,J22,J33,J44,J55,J66#",
        b"$4WD,PTZ90#\n",
    ],
)
def test_bytes_that_are_no_frame_of_the_table(data: bytes) -> None:
    assert parse_sent(data) is None


def test_rotation_wins_over_place_1() -> None:
    assert parse_sent(b"$1,2,0,0,0,0,0,0,0#") == General(Motion.SPIN_RIGHT)


@given(st.binary(max_size=60))
def test_parsing_what_was_sent_never_raises(data: bytes) -> None:
    parse_sent(data)
    parse_sent(b"$4WD," + data + b"#")
