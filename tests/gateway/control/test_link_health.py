"""Tests of the link health: each state, its reason, and the counters."""

import pytest

from gateway.control.link_health import LinkHealth
from schemas.words import LinkState


def judged(
    health: LinkHealth,
    now: float,
    *,
    limit_s: float | None = 3.0,
    unheard_s: float = float("inf"),
    is_heard: bool = True,
) -> LinkState:
    health.update(now=now, limit_s=limit_s, unheard_s=unheard_s, why_quiet="color_led is silent", is_heard=is_heard)
    return health.state


@pytest.mark.parametrize("start", [0.0, 50.0])
def test_from_lost_to_online_to_stale_and_back(start: float) -> None:
    health = LinkHealth(since=start)
    assert (judged(health, start + 9), health.reason) == (LinkState.LOST, "not connected yet")
    health.on_open(start + 10)
    assert (judged(health, start + 12), health.reason) == (LinkState.STALE, "open, no reading yet")
    judged(health, start + 14)
    assert health.reason == "no reading for 4.0 s, expected every 3 s"
    health.on_bytes(10, start + 14)
    assert judged(health, start + 14) is LinkState.STALE, "bytes that are no reading"
    health.on_reading(start + 15)
    assert (judged(health, start + 15), health.since) == (LinkState.ONLINE, start + 15)
    assert judged(health, start + 18) is LinkState.ONLINE
    assert judged(health, start + 18.1) is LinkState.STALE
    assert judged(health, start + 20, unheard_s=1.0) is LinkState.QUIET
    assert health.reason == "the car is busy"
    assert judged(health, start + 30, limit_s=None) is LinkState.QUIET
    assert health.reason == "color_led is silent"
    health.on_reading(start + 31)
    assert judged(health, start + 31) is LinkState.ONLINE
    health.on_lost("unplugged", start + 32)
    assert (judged(health, start + 99), health.reason, health.since) == (LinkState.LOST, "unplugged", start + 32)


def test_opened_at_the_origin_of_the_clock() -> None:
    health = LinkHealth()
    health.on_open(0.0)
    judged(health, 5.0)
    assert health.reason == "no reading for 5.0 s, expected every 3 s"


def test_silent_mode_link_is_quiet_and_heard_bytes_count() -> None:
    health = LinkHealth()
    health.on_open(1.0)
    assert judged(health, 2.0, limit_s=None) is LinkState.QUIET
    health.on_reading(3.0)
    assert judged(health, 5.0, limit_s=None) is LinkState.ONLINE
    assert judged(health, 6.1, limit_s=None) is LinkState.QUIET


def test_new_connection_is_not_online_by_old_bytes() -> None:
    health = LinkHealth()
    health.on_open(1.0)
    health.on_reading(2.0)
    assert judged(health, 2.0) is LinkState.ONLINE
    health.on_lost("gone", 3.0)
    health.on_open(3.5)
    assert judged(health, 3.6) is LinkState.STALE
    assert health.reconnects == 1


@pytest.mark.parametrize("limit_s", [3.0, None])
def test_link_of_unheard_car_is_not_online(limit_s: float | None) -> None:
    health = LinkHealth()
    health.on_open(1.0)
    health.on_reading(2.0)
    assert judged(health, 2.5, limit_s=limit_s, is_heard=False) is LinkState.STALE
    assert health.reason == "no reading for 0.5 s: it may be moving"
    assert judged(health, 2.6, limit_s=limit_s) is LinkState.ONLINE


def test_no_time_is_negative() -> None:
    """A reading may have a later time than the clock that rates the link."""
    health = LinkHealth()
    health.on_open(1.0)
    health.on_reading(7.0)
    judged(health, 2.0, is_heard=False)
    assert health.reason.startswith("no reading for 0.0 s")


def test_counters() -> None:
    health = LinkHealth()
    for cause in ("truncated", "truncated", "overlong"):
        health.on_rejected(cause)
    assert health.rejects == {"truncated": 2, "overlong": 1}
    for second in range(20):
        health.on_written(96, float(second))
    assert (health.tx_frames, health.tx_bytes) == (20, 1920)
    assert health.airtime(19.0) == pytest.approx(11 * 96 / 9600)
    assert health.airtime(100.0) == 0.0
    for _ in range(200):
        health.on_written(96, 200.0)
    assert health.airtime(200.0) == 1.0


def test_change_is_told_once() -> None:
    health = LinkHealth()
    health.on_open(1.0)
    health.on_reading(2.0)
    assert health.update(now=2.0, limit_s=3.0, unheard_s=0.0, why_quiet="", is_heard=True)
    assert not health.update(now=2.5, limit_s=3.0, unheard_s=0.0, why_quiet="", is_heard=True)
