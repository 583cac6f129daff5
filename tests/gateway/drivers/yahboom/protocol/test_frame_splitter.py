"""Readings of the table, bad input by cause, and the rules of framing."""

import pytest

from gateway.control.driver import Echo, Rejected, TextLine
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.measurements import verdict_of
from gateway.drivers.yahboom.protocol.sensors import Sensors, head_of
from gateway.drivers.yahboom.protocol.wire_events import ArmReading, Event, ImuReading
from schemas.words import Cause
from tests.support.vectors import ids, rows, wire

SENSORS, OTHERS, BAD = rows("sensors"), rows("other_readings"), rows("bad_input")
GOOD = b"$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#"
FOLLOWING = b"$4WD,CSB120,PV8.3,GS000,LF0000,HW10,GM00"


def one(data: bytes) -> Event:
    decoder = FrameSplitter()
    (event,) = decoder.feed(data, 1.0)
    assert decoder.deadline() is None
    return event


def bits(text: str) -> tuple[bool, ...] | None:
    return None if text == "-" else tuple(digit == "1" for digit in text)


def number(text: str) -> float | None:
    return None if text == "-" else float(text)


@pytest.mark.parametrize("row", SENSORS, ids=ids(SENSORS))
def test_sensors_frame_of_the_table(row: dict[str, str]) -> None:
    raw = wire(row["bytes"])
    event = one(raw)
    assert isinstance(event, Sensors)
    assert (event.raw, event.at, event.terminated, event.by_silence) == (raw, 1.0, True, False)
    assert event.range_cm == number(row["range_cm"])
    assert event.voltage_v == number(row["voltage_v"])
    assert event.grayscale == number(row["grayscale"])
    assert event.line == bits(row["line"])
    assert event.obstacle == bits(row["obstacle"])
    assert event.light == bits(row["light"])
    assert [f"{reject.word}={reject.text}" for reject in event.rejects] == row["rejects"].split()
    assert {reject.cause for reject in event.rejects} <= {Cause.OUT_OF_RANGE}


@pytest.mark.parametrize("row", OTHERS, ids=ids(OTHERS))
def test_arm_and_gyro_frames_of_the_table(row: dict[str, str]) -> None:
    event = one(wire(row["bytes"]))
    values = tuple(number(text) for text in row["values"].split())
    if row["kind"] == "arm":
        assert isinstance(event, ArmReading)
        assert event.joint_deg == values
        assert len(event.rejects) == values.count(None)
    else:
        assert isinstance(event, ImuReading)
        assert event.gyro + event.accel == values


@pytest.mark.parametrize("row", BAD, ids=ids(BAD))
def test_bad_frames_are_counted_by_cause_and_next_decodes(row: dict[str, str]) -> None:
    bad = wire(row["bytes"])
    *rejected, good = FrameSplitter().feed(bad + GOOD, 1.0)
    assert [event.cause for event in rejected if isinstance(event, Rejected)] == row["causes"].split()
    assert len(rejected) == len(row["causes"].split())
    assert b"".join(event.raw for event in rejected) == (bad.strip() if row["causes"] != "truncated" else bad)
    assert isinstance(good, Sensors)
    assert good.raw == GOOD


def test_causes_are_all_tested() -> None:
    seen = {cause for row in BAD for cause in row["causes"].split()}
    # Other tests cover the causes overlong and out of range: the first needs many bytes, the second rejects fields.
    assert seen | {Cause.OVERLONG, Cause.OUT_OF_RANGE} == set(Cause)


def test_missing_frame_end_is_accepted_at_next_frame() -> None:
    first, second = FrameSplitter().feed(FOLLOWING + GOOD, 1.0)
    assert isinstance(first, Sensors)
    assert (first.raw, first.terminated, first.by_silence) == (FOLLOWING, False, False)
    assert isinstance(second, Sensors)
    assert second.terminated


def test_missing_frame_end_is_accepted_after_50_ms_silence() -> None:
    decoder = FrameSplitter()
    assert decoder.feed(FOLLOWING, 1.0) == []
    assert decoder.deadline() == pytest.approx(1.05)
    assert decoder.flush(1.049) == []
    (event,) = decoder.flush(decoder.deadline() or 0.0)
    assert isinstance(event, Sensors)
    assert (event.raw, event.at, event.terminated, event.by_silence) == (FOLLOWING, 1.0, False, True)
    assert decoder.deadline() is None
    assert decoder.flush(9.0) == []


def test_feed_sees_a_silence_that_no_tick_told_it_of() -> None:
    decoder = FrameSplitter()
    decoder.feed(FOLLOWING, 1.0)
    first, second = decoder.feed(GOOD, 2.0)
    assert isinstance(first, Sensors)
    assert (first.at, first.by_silence) == (1.0, True)
    assert isinstance(second, Sensors)


def test_late_frame_end_is_no_junk() -> None:
    decoder = FrameSplitter()
    decoder.feed(FOLLOWING, 1.0)
    assert len(decoder.flush(1.06)) == 1
    (event,) = decoder.feed(b"#" + GOOD, 1.07)
    assert isinstance(event, Sensors)
    (junk,) = decoder.feed(b"#" + b"$", 2.0)
    assert isinstance(junk, Rejected), "only the first one is late"


@pytest.mark.parametrize("cut", range(1, len(FOLLOWING)))
def test_rest_of_frame_may_be_late(cut: int) -> None:
    decoder = FrameSplitter()
    decoder.feed(FOLLOWING[:cut], 1.0)
    assert decoder.flush(1.49) == []
    (event,) = decoder.feed(FOLLOWING[cut:] + b"#", 1.49)
    assert isinstance(event, Sensors), "a radio repeats what it lost"


@pytest.mark.parametrize("ticks", [True, False])
@pytest.mark.parametrize("cut", range(1, len(FOLLOWING)))
def test_silence_ends_an_incomplete_frame(cut: int, *, ticks: bool) -> None:
    decoder = FrameSplitter()
    decoder.feed(FOLLOWING[:cut], 1.0)
    assert decoder.deadline() == pytest.approx(1.5)
    events = decoder.flush(1.5) if ticks else []
    events += decoder.feed(FOLLOWING[cut:] + b"#" + GOOD, 3.0)
    assert isinstance(events[-1], Sensors)
    assert [each.cause for each in events[:-1] if isinstance(each, Rejected)] == [Cause.TRUNCATED, Cause.NO_START]


def test_silence_ends_a_run_of_junk() -> None:
    decoder = FrameSplitter()
    assert decoder.feed(b"hel", 1.0) == []
    assert decoder.feed(b"lo\r\n", 1.02) == []
    assert decoder.deadline() == pytest.approx(1.07)
    assert decoder.flush(1.07) == [TextLine(b"hello\r\n", 1.02)]
    decoder.feed(b"hello", 2.0)
    assert decoder.flush(2.05) == [Rejected(b"hello", 2.0, Cause.NO_START, "5 bytes outside a frame")]


def test_separators_between_frames_make_no_event_and_want_no_tick() -> None:
    decoder = FrameSplitter()
    assert len(decoder.feed(GOOD + b"\r\n", 1.0)) == 1
    assert decoder.deadline() is None
    assert decoder.feed(b"\r\n \t" * 1000, 1.0) == []
    assert decoder.end() == []


def test_time_is_that_of_the_last_byte() -> None:
    decoder = FrameSplitter()
    decoder.feed(GOOD[:10], 1.0)
    decoder.feed(GOOD[10:-1], 1.01)
    (event,) = decoder.feed(GOOD[-1:], 1.02)
    assert event.at == 1.02
    decoder.feed(FOLLOWING, 2.0)
    first, *_ = decoder.feed(GOOD, 2.04)
    assert first.at == 2.0, "the next frame's `$` is not its last byte"
    decoder.feed(b"junk", 3.0)
    junk, *_ = decoder.feed(GOOD, 3.04)
    assert junk.at == 3.0
    decoder.feed(b"$", 4.0)
    decoder.feed(b"$", 4.5)
    truncated, *_ = decoder.feed(b"$", 5.0)
    assert truncated.at == 4.5


class TestOverlong:
    def test_256_bytes_are_a_frame_and_257_are_noise(self) -> None:
        longest = (
            b"$4WD,CSB" + b"0" * (256 - len(b"$4WD,CSB,PV8.3,GS1,LF0000,HW00,GM00#")) + b",PV8.3,GS1,LF0000,HW00,GM00#"
        )
        assert len(longest) == 256
        assert isinstance(one(longest), Sensors)
        longer = longest.replace(b"GS1", b"GS01")
        cut, tail, good = FrameSplitter().feed(longer + GOOD, 1.0)
        assert isinstance(cut, Rejected)
        assert (cut.cause, cut.raw) == (Cause.OVERLONG, longer[:256])
        assert isinstance(tail, Rejected)
        assert (tail.cause, tail.raw) == (Cause.NO_START, b"#")
        assert isinstance(good, Sensors)

    def test_256_bytes_and_then_a_start_are_truncated(self) -> None:
        cut, good = FrameSplitter().feed(b"$" + b"x" * 255 + GOOD, 1.0)
        assert isinstance(cut, Rejected)
        assert cut.cause is Cause.TRUNCATED
        assert isinstance(good, Sensors)

    def test_frame_that_never_ends_is_held_in_bounds(self) -> None:
        decoder = FrameSplitter()
        events = [event for _ in range(5000) for event in decoder.feed(b"$4WD,CSB" + b"1" * 20 + b"." * 200, 1.0)]
        assert len(decoder._buffer) <= 256
        events = decoder.feed(b"1" * 1_000_000, 1.0)
        assert len(decoder._buffer) <= 256
        assert all(len(event.raw) <= 256 for event in events)
        assert len(events) <= 1_000_000 // 256 + 1
        assert isinstance(decoder.feed(GOOD, 1.0)[-1], Sensors)

    @pytest.mark.parametrize("most", [0, 63, 257, 10_000])
    def test_limit_is_itself_limited(self, most: int) -> None:
        with pytest.raises(ValueError, match=r"max_frame: \d+, allowed are 64\.\.256"):
            FrameSplitter(most)


class TestEcho:
    SENT = b"$4WD,ServoJ10,J230,J360,J490,J5120,J6180#"

    def test_our_own_frame_within_2_s_is_no_reading(self) -> None:
        decoder = FrameSplitter()
        decoder.sends(self.SENT, 1.0)
        assert decoder.feed(self.SENT, 3.0) == [Echo(self.SENT, 3.0)]
        assert isinstance(decoder.feed(self.SENT, 3.01)[0], ArmReading)

    def test_echo_in_pieces_and_repeated(self) -> None:
        decoder = FrameSplitter()
        decoder.sends(self.SENT, 1.0)
        events = [event for byte in self.SENT * 2 for event in decoder.feed(bytes([byte]), 1.5)]
        assert events == [Echo(self.SENT, 1.5)] * 2

    def test_sensors_frame_that_we_sent_is_an_echo_too(self) -> None:
        decoder = FrameSplitter()
        decoder.sends(GOOD, 1.0)
        assert decoder.feed(GOOD, 1.1) == [Echo(GOOD, 1.1)]
        assert isinstance(decoder.feed(GOOD, 3.1)[0], Sensors)

    def test_lone_end(self) -> None:
        decoder = FrameSplitter()
        decoder.sends(b"#", 1.0)
        decoder.sends(b"$4WD,MODE00#", 1.05)
        echoes = decoder.feed(b"#\r\n$4WD,MODE00#", 1.1)
        assert echoes == [Echo(b"#", 1.1), Echo(b"$4WD,MODE00#", 1.1)]

    def test_sent_frames_are_forgotten_after_a_while(self) -> None:
        decoder = FrameSplitter()
        for i in range(10_000):
            decoder.sends(b"$4WD,PTZ%d#" % i, i * 0.001)
        assert len(decoder._sent) <= 256
        decoder.sends(b"#", 100.0)
        assert list(decoder._sent) == [b"#"]


class TestEnd:
    def test_half_a_frame(self) -> None:
        decoder = FrameSplitter()
        decoder.feed(GOOD[:-5], 1.0)
        (event,) = decoder.end()
        assert isinstance(event, Rejected)
        assert (event.cause, event.raw) == (Cause.TRUNCATED, GOOD[:-5])
        assert decoder.end() == []

    def test_whole_frame_without_end_counts_after_silence(self) -> None:
        decoder = FrameSplitter()
        decoder.feed(FOLLOWING, 1.0)
        (event,) = decoder.end()
        assert isinstance(event, Sensors)
        assert event.by_silence
        assert isinstance(decoder.feed(b"#$", 1.0)[0], Rejected), "a new link has no late end"

    def test_junk(self) -> None:
        decoder = FrameSplitter()
        decoder.feed(b"junk", 1.0)
        (event,) = decoder.end()
        assert isinstance(event, Rejected)
        assert event.cause is Cause.NO_START


def kinds(events: list[Event]) -> list[tuple[str, bytes]]:
    return [(verdict_of(event), event.raw) for event in events]


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
def test_whole_line_of_text_is_no_damage(end: bytes) -> None:
    line = b"EXEC:F" + end
    events = FrameSplitter().feed(GOOD + line + GOOD + b"\r\n" + line + b"Motor on, 3 A" + end + GOOD, 1.0)
    expected = [GOOD, line, GOOD, line, b"Motor on, 3 A" + end, GOOD]
    assert kinds(events) == [("sensors" if raw == GOOD else "text", raw) for raw in expected]


NO_TEXT = [
    b"EXEC:F",  # cut: another frame began
    b"EX\x80C:F\r\n",
    b"EXEC#F\r\n",
    b"4WD,hello\r\n",
    b",HW00,GM10\r\n",
    b"CSB12\r\n",
    b"J190,J2\r\n",
    b"1,0,0\r\n",
    b"F\r\n",
]


@pytest.mark.parametrize("junk", NO_TEXT)
def test_piece_of_frame_or_line_is_no_text(junk: bytes) -> None:
    assert kinds(FrameSplitter().feed(junk + GOOD, 1.0)) == [("no_start", junk.rstrip()), ("sensors", GOOD)]


def test_text_and_damage_runs_are_separate_events() -> None:
    events = FrameSplitter().feed(b"\xff\r\n\xfe\r\nEXEC:F\r\n\r\n12\r\nEX" + GOOD, 1.0)
    expected = [("no_start", b"\xff\r\n\xfe"), ("text", b"EXEC:F\r\n"), ("no_start", b"12\r\nEX"), ("sensors", GOOD)]
    assert kinds(events) == expected


def test_rest_of_damaged_line_is_no_text() -> None:
    decoder = FrameSplitter()
    decoder.feed(b"\xff\xfe", 1.0)
    assert kinds(decoder.feed(b"EXEC:F\r\nEXEC:F\r\n", 2.0) + decoder.end()) == [
        ("no_start", b"\xff\xfe"),
        ("no_start", b"EXEC:F"),
        ("text", b"EXEC:F\r\n"),
    ]
    decoder.feed(b"\xff\xfe", 3.0)
    decoder.feed(b"\r\n", 4.0)
    assert kinds(decoder.feed(b"EXEC:F\r\n", 5.0) + decoder.end()) == [("text", b"EXEC:F\r\n")]


@pytest.mark.parametrize("size", [1, 7, 100])
def test_line_after_frame_is_whole(size: int) -> None:
    decoder = FrameSplitter()
    decoder.feed(b"\xff\xfe", 1.0)
    rest, events = GOOD + b"EXEC:F\r\n", []
    for start in range(0, len(rest), size):
        events += decoder.feed(rest[start : start + size], 2.0)
    assert kinds(events + decoder.end()) == [("no_start", b"\xff\xfe"), ("sensors", GOOD), ("text", b"EXEC:F\r\n")]


def test_rest_of_damaged_frame_is_no_text() -> None:
    decoder = FrameSplitter()
    decoder.feed(b"$4WD,CSB1", 1.0)
    assert kinds(decoder.feed(b"hello\r\n", 2.0) + decoder.end())[-1] == ("no_start", b"hello")
    overlong = b"$" + b"x" * 300 + b"\r\n"
    assert [kind for kind, _ in kinds(FrameSplitter().feed(overlong + GOOD, 1.0))] == [
        "overlong",
        "no_start",
        "sensors",
    ]


def test_recorded_text_decodes_to_same_events() -> None:
    decoder = FrameSplitter()
    for raw in (b"\xff", b"EXEC:F\r\n", b"hello", b"EXEC:F\r\n"):
        assert kinds(decoder.feed(raw, 1.0) + decoder.end()) == [("text" if b"EXEC" in raw else "no_start", raw)]


@pytest.mark.parametrize(
    ("raw", "head"),
    [
        (GOOD, "4WD"),
        (FOLLOWING.replace(b"4WD", b"BaLa"), "BaLa"),
        (GOOD.replace(b"4WD", b"A"), None),
        (GOOD[:-3], None),
        (b"$4WD,MODE00#", None),
    ],
)
def test_head_of_sensors_frame_is_read_from_its_bytes(raw: bytes, head: str | None) -> None:
    assert head_of(raw) == head
