"""A link's faults, on virtual time."""

import math
import random
from math import inf

import pytest

from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.sim.model.faulty_link import FLOOD_INTERVAL_S, TO_HOST_LIMIT, Direction, FaultyLink, Flood

FRAME = b"$1,0,0,0,0,0,0,0,0#"


def line(seed: int = 1) -> FaultyLink:
    return FaultyLink(random.Random(seed), random.Random(seed + 1))


def both(link: FaultyLink, data: bytes, now: float) -> tuple[bytes, bytes]:
    """Send the same bytes in both directions. Return the bytes that arrive at once at the car and at the host."""
    link.from_host(data, now)
    link.from_car(data, now)
    return b"".join(link.to_car(now)), b"".join(link.to_host(now))


def test_without_a_fault_bytes_pass_as_they_come() -> None:
    link = line()
    for now, data in enumerate((FRAME, b"", b"\x00\xff")):
        assert both(link, data, float(now)) == (data, data)
    assert link.next_event() == inf
    assert link.lost_bytes == {Direction.TO_CAR: 0, Direction.TO_HOST: 0}


def test_slow_link_delivers_bytewise_and_catches_up() -> None:
    link = line()
    link.slow(0.1, until=10.0)
    assert both(link, FRAME, 5.0) == (b"", b"")
    car, host = [], []
    while (now := link.next_event()) < inf:
        car += [(now, piece) for piece in link.to_car(now)]
        host += [(now, piece) for piece in link.to_host(now)]
    assert car == host
    assert b"".join(piece for _, piece in car) == FRAME
    assert [now for now, _ in car] == pytest.approx([5.0 + (n + 1) / 96 for n in range(len(FRAME))])
    link.from_host(FRAME, 9.99)
    link.from_host(b"later", 10.0)
    assert link.to_car(10.0) == []
    assert b"".join(link.to_car(9.99 + 19 / 96)) == FRAME + b"later", "nothing overtakes"


def test_frames_in_a_slow_link_queue_behind_each_other() -> None:
    link = line()
    link.slow(0.1, until=inf)
    link.from_host(FRAME, 0.0)
    link.from_host(FRAME, 0.1)
    assert b"".join(link.to_car(37.5 / 96)) == (FRAME + FRAME)[:37]
    assert b"".join(link.to_car(38.5 / 96)) == b"#"


def test_slow_link_buffers_a_bounded_amount() -> None:
    link = line()
    link.slow(0.001, until=inf)
    for _ in range(100):
        link.from_car(bytes(100), 0.0)
    out = b"".join(link.to_host(1e6))
    assert len(out) == TO_HOST_LIMIT
    assert link.lost_bytes[Direction.TO_HOST] == 10_000 - TO_HOST_LIMIT
    link.from_car(b"again", 1e6)
    assert b"".join(link.to_host(1e6 + 100)) == b"again"


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_lossy_link_loses_its_share(share: float) -> None:
    link = line()
    link.lossy(share, tuple(Direction), until=5.0)
    data = random.Random(3).randbytes(10_000)
    for out in both(link, data, 1.0):
        expected = 10_000 * (1 - share)
        assert abs(len(out) - expected) <= 4 * math.sqrt(10_000 * share * (1 - share))
    assert link.lost_bytes[Direction.TO_CAR] > 0 or share == 0
    assert both(link, FRAME, 5.0) == (FRAME, FRAME), "it ends"


def test_loss_depends_on_seed_and_own_bytes() -> None:
    def run(seed: int, *, other: bool, piece: int) -> bytes:
        link = line(seed)
        link.lossy(0.3, tuple(Direction), until=inf)
        out = b""
        data = bytes(range(256)) * 4
        for start in range(0, len(data), piece):
            if other:
                link.from_car(b"something else", 0.0)
            link.from_host(data[start : start + piece], 0.0)
            out += b"".join(link.to_car(0.0))
        return out

    assert run(1, other=False, piece=1024) == run(1, other=True, piece=1) == run(1, other=False, piece=7)
    assert run(1, other=False, piece=1024) != run(2, other=False, piece=1024)


@pytest.mark.parametrize("way", list(Direction))
def test_lossy_or_closed_way_leaves_other_way_whole(way: Direction) -> None:
    for fault in ("lossy", "closed"):
        link = line()
        if fault == "lossy":
            link.lossy(1.0, (way,), until=2.0)
        else:
            link.close(way, until=2.0)
        out = dict(zip((Direction.TO_CAR, Direction.TO_HOST), both(link, FRAME, 1.0), strict=True))
        assert out.pop(way) == b""
        assert list(out.values()) == [FRAME]
        assert link.lost_bytes[way] == len(FRAME)
        assert both(link, FRAME, 2.0) == (FRAME, FRAME)


def test_echo_link_returns_and_delivers_bytes() -> None:
    link = line()
    link.echo(until=2.0)
    link.from_host(FRAME, 1.0)
    assert link.to_car(1.0) == link.to_host(1.0) == [FRAME]
    link.from_host(FRAME, 2.0)
    assert link.to_host(2.0) == []


@pytest.mark.parametrize("count", [0, 1, 10, 19, 30])
@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_write_is_cut_after_given_bytes(count: int, piece: int) -> None:
    link = line()
    link.cut_next(count)
    data = b"0,0#\r\n" + FRAME + FRAME
    out = b""
    for start in range(0, len(data), piece):
        assert not link.cut or len(out) == 6 + count
        link.from_host(data[start : start + piece], 0.0)
        out += b"".join(link.to_car(0.0))
    assert out == data[: 6 + count]
    assert link.cut
    link.mend()
    link.from_host(FRAME, 1.0)
    assert link.to_car(1.0) == [FRAME]
    assert not link.cut


def test_cut_waits_for_bytes_before_it() -> None:
    link = line()
    link.slow(1.0, until=inf)
    link.cut_next(5)
    link.from_host(FRAME, 0.0)
    link.to_car(4.5 / 960)
    assert not link.cut
    link.to_car(5.5 / 960)
    assert link.cut


@pytest.mark.parametrize("rate", [10.0, 960.0, 1e6])
def test_firehose_has_its_rate_at_any_poll_times(rate: float) -> None:
    link, moments = line(), random.Random(2)
    link.flood(Flood.NOISE, rate, 1.0, until=6.0)
    out, now = b"", 1.0
    while (due := link.next_event()) < inf:
        now = due + 0.1 * moments.random()
        out += b"".join(link.to_host(now))
    assert now >= 6.0
    assert len(out) == pytest.approx(5 * rate, rel=0.01, abs=2)
    assert len(set(out)) > min(200, len(out) / 3)


def test_unread_firehose_is_bounded() -> None:
    link = line()
    link.flood(Flood.NOISE, 1e6, 0.0, until=inf)
    assert sum(map(len, link.to_host(3600.0))) == 1_000_000
    assert link.next_event() == pytest.approx(3600.0 + FLOOD_INTERVAL_S)


def test_endless_flood_frame_is_one_frame() -> None:
    link = line()
    link.flood(Flood.FRAME, 10_000, 0.0, until=2.0)
    out = b"".join(b"".join(link.to_host(n / 1000)) for n in range(2001))
    assert len(out) == pytest.approx(20_000, abs=2)
    assert out.startswith(b"$4WD,CSB0000")
    assert out.count(b"$") == 1
    assert b"#" not in out
    decoder = FrameSplitter()
    assert any("overlong" in str(event) for event in decoder.feed(out, 0.0))


def test_cleared_link_forgets_bytes_in_transit() -> None:
    link = line()
    link.slow(0.1, until=inf)
    both(link, FRAME, 0.0)
    link.clear()
    assert link.next_event() == inf
    assert link.waiting() == 0
    assert link.lost_bytes == {Direction.TO_CAR: 19, Direction.TO_HOST: 19}
