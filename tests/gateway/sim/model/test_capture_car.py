"""A capture that plays as a car, on virtual time."""

from math import inf

import pytest

from gateway.sim.model.capture_car import LOOP_PAUSE_S, CaptureCar

PIECES = [(0.5, b"a"), (0.5, b"b"), (2.5, b"c")]


def heard(played: CaptureCar, until: float) -> list[tuple[float, bytes]]:
    out = []
    while (due := played.next_event()) <= until:
        out += played.advance(due)
    return out


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_times_of_the_file_are_kept(rate: float) -> None:
    played = CaptureCar(PIECES, rate=rate, now=10.0)
    assert heard(played, inf if rate < 0 else 1000.0) == [(10.0 + at / rate, data) for at, data in PIECES]
    assert played.done
    assert (played.rounds, played.sent_bytes) == (1, 3)
    assert played.next_event() == inf


def test_one_late_look_gives_all_that_was_due() -> None:
    played = CaptureCar(PIECES, now=0.0)
    assert [data for _, data in played.advance(1.0)] == [b"a", b"b"]
    assert played.advance(2.0) == []


@pytest.mark.parametrize("pieces", [PIECES, [(0.0, b"x")]])
def test_loop_begins_again_after_a_pause(pieces: list[tuple[float, bytes]]) -> None:
    played = CaptureCar(pieces, rate=2.0, loop=True, now=0.0)
    times = [at for at, _ in heard(played, 20.0)]
    length = (pieces[-1][0] + LOOP_PAUSE_S) / 2
    assert times[: len(pieces) * 2] == pytest.approx([start + at / 2 for start in (0.0, length) for at, _ in pieces])
    assert played.rounds == int((20.0 + LOOP_PAUSE_S / 2 + 1e-9) / length)
    assert not played.done


def test_capture_waits_for_host_and_does_not_restart() -> None:
    played = CaptureCar(PIECES)
    assert played.next_event() == inf
    assert played.advance(100.0) == []
    played.begin(200.0)
    played.begin(201.0)
    assert played.next_event() == 200.5


def test_capture_car_ignores_commands() -> None:
    played = CaptureCar(PIECES, now=0.0)
    played.feed(b"$0,0,0,0,0,0,0,0,0#", 0.1)
    played.drop_link(0.2)
    assert played.ignored_bytes == 19
    assert played.backlog(0.2) == 0
    assert played.truth is None
    assert played.pose(0.2) is None
