"""Any bytes give the same events, wherever they are cut. Readings of every spelling decode to their values."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.wire_events import Event, ImuReading

PIECES = (
    b"$",
    b"#",
    b",",
    b"\r\n",
    b"4WD",
    b"hello",
    b"EXEC:F\r\n",
    b"EXEC:F",
    b"\n",
    b"GM00",
    b"x" * 130,
    b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#",
    b"$4WD,CSB120,PV8.3,GS000,LF0000,HW10,GM00",
    b"$4WD,CSB1300,PV8.3,GS000,LF0020,HW10,GM00#",
    b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#",
    b"$4WD,J11,J22,J33,J44,J55,J66#",
    b"$4WD,MPUgx1,MPUgy-2,MPUgz3,MPUax-4,MPUay5,MPUaz-6#",
    b"$4WD,MODE00#",
)
STREAM = st.lists(st.one_of(st.sampled_from(PIECES), st.binary(max_size=8)), max_size=12).map(b"".join)
# bursts with the silence before each, seconds
BURSTS = st.lists(st.tuples(STREAM, st.sampled_from([0.0, 0.01, 0.049, 0.051, 0.2, 0.51, 3.0])), min_size=1, max_size=5)


def timeless(events: list[Event]) -> list[Event]:
    return [replace(event, at=0.0) for event in events]


def events_of(bursts: list[tuple[bytes, float]], size: int | None, *, ticks: bool) -> list[Event]:
    """Return all events of bursts in pieces of `size` bytes, with or without the requested ticks."""
    decoder, now, events = FrameSplitter(), 100.0, []
    decoder.sends(b"$4WD,MODE00#", now)
    decoder.sends(b"#", now)
    for burst, silence in bursts:
        now += silence
        if ticks and (due := decoder.deadline()) is not None and due <= now:
            events += decoder.flush(due)
            assert decoder.deadline() is None
        step = size or max(len(burst), 1)
        for start in range(0, len(burst), step):
            events += decoder.feed(burst[start : start + step], now)
            assert len(decoder._buffer) <= 256
    return timeless(events + decoder.end())


@given(BURSTS)
def test_same_events_however_the_bytes_are_cut(bursts: list[tuple[bytes, float]]) -> None:
    whole = events_of(bursts, None, ticks=False)
    for size, ticks in ((1, False), (2, False), (20, False), (None, True), (1, True), (20, True)):
        assert events_of(bursts, size, ticks=ticks) == whole


@given(STREAM, st.lists(st.integers(0, 2000), max_size=8))
def test_same_events_for_arbitrary_cuts(stream: bytes, cuts: list[int]) -> None:
    whole = FrameSplitter()
    cut = FrameSplitter()
    edges = sorted({0, len(stream), *(edge for edge in cuts if edge < len(stream))})
    events = [event for start, end in pairwise(edges) for event in cut.feed(stream[start:end], 1.0)]
    assert events + cut.end() == whole.feed(stream, 1.0) + whole.end()


@given(st.one_of(STREAM, st.binary(max_size=2000)))
def test_no_byte_is_lost_or_seen_twice(stream: bytes) -> None:
    decoder = FrameSplitter()
    events = decoder.feed(stream, 1.0) + decoder.end()
    assert all(0 < len(event.raw) <= 256 for event in events)
    place = 0
    for event in events:
        start = stream.index(event.raw, place)
        assert not stream[place:start].strip(b"\r\n \t")
        place = start + len(event.raw)
    assert not stream[place:].strip(b"\r\n \t")


@given(st.binary(max_size=3000).filter(lambda garbage: b"$" not in garbage[-300:]))
def test_good_frame_after_any_garbage_decodes(garbage: bytes) -> None:
    good = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"
    event = FrameSplitter().feed(garbage + good, 1.0)[-1]
    assert isinstance(event, Sensors)
    assert event.raw == good


@st.composite
def spelled(draw: st.DrawFn, top: int) -> str:
    whole = draw(st.integers(0, top - 1))
    decimals = draw(st.sampled_from(["", ".{:01d}", ".{:02d}"]))
    most = {"": 0, ".{:01d}": 9, ".{:02d}": 99}[decimals]
    return f"{whole}{decimals.format(draw(st.integers(0, most)))}"


BITS = st.sampled_from("01")


@given(
    spelled(1200),
    spelled(13),
    st.integers(0, 4095),
    st.sampled_from([1, 3, 4]),
    st.lists(BITS, min_size=8, max_size=8).map("".join),
    st.booleans(),
)
def test_readings_of_every_spelling(csb: str, pv: str, gs: int, pad: int, bits: str, ended: bool) -> None:
    text = f"$4WD,CSB{csb},PV{pv},GS{gs:0{pad}d},LF{bits[:4]},HW{bits[4:6]},GM{bits[6:]}{'#' if ended else ''}"
    event = FrameSplitter().feed(text.encode() + b"$", 1.0)[0]
    assert isinstance(event, Sensors)
    assert (event.range_cm, event.voltage_v, event.grayscale) == (float(csb), float(pv), gs)
    seen = (*(event.line or ()), *(event.obstacle or ()), *(event.light or ()))
    assert seen == tuple(bit == "1" for bit in bits)
    assert (event.rejects, event.terminated) == ((), ended)


RAW = st.one_of(st.integers(-32768, 32767).map(str), st.decimals(-32768, 32767, places=2).map("{:f}".format))


@given(st.lists(RAW, min_size=6, max_size=6))
def test_gyro_readings(raw: list[str]) -> None:
    words = ("MPUgx", "MPUgy", "MPUgz", "MPUax", "MPUay", "MPUaz")
    frame = "$4WD," + ",".join(word + text for word, text in zip(words, raw, strict=True)) + "#"
    (event,) = FrameSplitter().feed(frame.encode(), 1.0)
    assert isinstance(event, ImuReading)
    assert event.gyro + event.accel == tuple(map(float, raw))
