"""Invalid bytes at a real gateway: the gateway stays, its memory is bounded, and it reads the next good frame."""

import itertools
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.kills import BUSY_S
from tests.support.processes import MODE00, TAKEN, FleetProcesses, GatewayProcess, TcpCar, driving, wait_for

RUN = b"$1,0,0,0,0,0,0,0,0#"
STOP = b"$0,0,0,0,0,0,0,0,0#"
MEGABYTE = 1_000_000
BOUND_MB = 25.0
"""Maximum growth of a gateway's memory by any amount of invalid bytes. Measured: 2 to 9 MB."""
RANDOM = random.Random(7).randbytes(MEGABYTE)
NEVER_ENDING = b"$" + b"9" * MEGABYTE
NUMBERS = itertools.count(100)


def good_frame_counts(fleet: FleetProcesses, send: Callable[[bytes], None]) -> None:
    """Check that the gateway reads a good frame. Repeat it: the first one may become part of the invalid bytes."""
    distance = next(NUMBERS)
    due = 0.0

    def measured() -> Any:
        nonlocal due
        if time.monotonic() >= due:
            send(b"#$4WD,CSB%d.00,PV7.91,GS5,LF0000,HW00,GM11#" % distance)
            due = time.monotonic() + 1.0
        readings = fleet.get("fleet/red/sensor/range")
        return readings and round(readings[0].range_m * 100) == distance

    wait_for(measured, "a reading")


@pytest.fixture
def gateway(fleet: FleetProcesses, tcp_car: TcpCar) -> GatewayProcess:
    started = fleet.gateway(tcp_car.link)
    wait_for(lambda: MODE00 in tcp_car.received, "it is on the link")
    good_frame_counts(fleet, tcp_car.send)
    return started


@pytest.mark.parametrize(
    ("nonsense", "causes"),
    [(RANDOM, {"no_start", "truncated", "unknown_word"}), (NEVER_ENDING, {"overlong", "no_start"})],
    ids=["random", "a frame that never ends"],
)
def test_megabyte_of_nonsense_is_rejected_without_growth(
    fleet: FleetProcesses, tcp_car: TcpCar, gateway: GatewayProcess, nonsense: bytes, causes: set[str]
) -> None:
    before_mb = gateway.rss_mb()
    tcp_car.send(nonsense)
    good_frame_counts(fleet, tcp_car.send)
    wait_for(lambda: fleet.state("link").rx_bytes > MEGABYTE, "it says how much came")
    link = fleet.state("link")
    assert causes <= set(link.rejects)
    assert sum(link.rejects.values()) > 1000
    assert gateway.rss_mb() < before_mb + BOUND_MB
    assert gateway.popen.poll() is None
    assert "Traceback" not in gateway.stderr


@pytest.mark.soak
def test_silent_link_keeps_recovery_going(fleet: FleetProcesses, tcp_car: TcpCar) -> None:
    """The gateway reports that the car is silent, and goes on with recovery. A drive is sent, and nothing shows it."""
    gateway = fleet.gateway(tcp_car.link)
    wait_for(lambda: "silent since the stop began" in gateway.stderr, "it is said")
    assert fleet.state("safety").motors == "unknown"
    for _ in range(2):
        written = len(tcp_car.received)
        wait_for(lambda written=written: tcp_car.received[written:].count(MODE00) >= 2, "recovery goes on")
    answer = fleet.ask("drive", motion="forward")
    assert answer["status"] in TAKEN, answer
    assert "nothing shows that it hears this" in answer["words"]
    wait_for(lambda: RUN in tcp_car.received, "what is not shown forbids nothing")
    tcp_car.obey()
    fleet.ready()
    assert fleet.state("safety").motors_basis == "shown"


def test_echoes_are_no_readings(fleet: FleetProcesses) -> None:
    car = TcpCar(echoes=True)
    try:
        gateway = fleet.gateway(car.link)
        frames: list[Any] = []
        fleet.bus.subscribe("fleet/red/frame/rx", lambda sample: frames.append(sample.message()))
        wait_for(lambda: car.received[3:4] == [STOP], "a whole recovery")
        wait_for(lambda: [frame.data for frame in frames].count(STOP) == 1, "its last echo")
        assert {frame.verdict for frame in frames} == {"echo"}
        assert not fleet.get("fleet/red/sensor/*")
        assert fleet.state("safety").motors == "unknown", "an echo confirms nothing"
        assert fleet.state("mode").inferred == "unknown"
        good_frame_counts(fleet, car.send)
        assert fleet.state("safety").motors == "unknown", "a reading alone confirms no stop"
        car.obey()
        wait_for(lambda: fleet.state("safety").motors == "off", "block gaps in its reports confirm one")
        assert fleet.state("safety").motors_basis == "shown"
        assert gateway.popen.poll() is None
    finally:
        car.close()


def plugged_in(kept: list[int]) -> Path:
    """Open another device; return its path. The system assigns the lowest free number, so keep the lower ones open."""
    master, slave = os.openpty()
    kept += (master, slave)
    return Path(os.ttyname(slave))


def test_by_id_path_reconnects_to_renumbered_device(fleet: FleetProcesses, tmp_path: Path) -> None:
    """Its by-id path, a symlink, stays the same."""
    sim, (link,) = fleet.simulate(f"red:arduino:pty:{tmp_path / 'by-id'}")
    fleet.gateway(link)
    fleet.ready()
    assert fleet.ask("drive", motion="forward", duration_s=10)["status"] in TAKEN
    wait_for(lambda: driving(sim), "it drives")
    before = (tmp_path / "by-id").readlink()
    sim.say({"car": "red", "fault": "link_drop"})
    wait_for(lambda: fleet.state("link").state == "lost", "lost")
    taken: list[int] = []
    try:
        wait_for(lambda: plugged_in(taken) == before or before.exists(), "somebody else gets its number")
        sim.say({"car": "red", "fault": "link_drop", "for_s": 0})
        wait_for(lambda: not driving(sim), "it is stopped")
        assert (tmp_path / "by-id").readlink() != before
        fleet.ready()
        assert fleet.state("link").reconnects == 1
    finally:
        for end in taken:
            os.close(end)


A_CLOCK_THAT_JUMPS = """
import signal, time
true, jumped = time.time_ns, [0]
time.time_ns = lambda: true() + jumped[0]
time.time = lambda: time.time_ns() / 1e9
for number, hours in ((signal.SIGUSR1, 24), (signal.SIGUSR2, -24)):
    signal.signal(number, lambda *_, hours=hours: jumped.__setitem__(0, jumped[0] + hours * 3600 * 10**9))
from gateway.cli import main
main()
"""


def test_wall_clock_jump_changes_no_motion(fleet: FleetProcesses) -> None:
    """Drives and stops use the monotonic clock. The wall clock only stamps messages and dates commands."""
    sim, (link,) = fleet.simulate("red:raspberry_pi:tcp")
    gateway = fleet.start("-c", A_CLOCK_THAT_JUMPS, "run", "--car", "red", "--link", link, "--platform", "raspberry_pi")
    fleet.ready()
    for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGUSR2):
        fleet.ready()  # wait for the stop of the round before
        stamp_s = fleet.state("health").stamp.seconds
        answer = fleet.ask("drive", motion="forward", duration_s=3.0)
        assert answer["status"] in TAKEN, answer
        wait_for(lambda: driving(sim), "it drives")  # long enough to last until the clock jumps
        os.kill(gateway.pid, number)
        wait_for(
            lambda stamp_s=stamp_s: abs(fleet.state("health").stamp.seconds - stamp_s) > 80_000, "the clock has jumped"
        )
        wait_for(lambda: not driving(sim), "it stops when its time is over", 8.0)
        assert fleet.ask("drive", motion="back", duration_s=10)["status"] in TAKEN, "undated is fresh"
        wait_for(lambda: driving(sim), "it drives back")
        asked = {"asked": f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())}"}
        assert fleet.ask("stop", kind="person", **asked)["status"] in TAKEN, "a stop is never stale"
        wait_for(lambda: not driving(sim), "it stands")
    fleet.ready()
    # This clock is a day behind the others. Their drives are from the future: nobody knows how old they are.
    dated = {"asked": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    answer = fleet.ask("drive", motion="forward", **dated)
    assert (answer["status"], answer["reason"]) == ("rejected", "stale")
    for ahead_s in (-10_000, 80_000):
        os.kill(gateway.pid, signal.SIGUSR1)
        wait_for(
            lambda more_s=ahead_s: fleet.state("health").stamp.seconds > time.time() + more_s, "it has jumped again"
        )
    answer = fleet.ask("drive", motion="forward", **dated)
    assert (answer["status"], answer["reason"]) == ("rejected", "stale")
    assert gateway.popen.poll() is None
    assert "Traceback" not in gateway.stderr


@pytest.mark.parametrize(
    "nonsense",
    [b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM11#" * 500, b"$" * 20_000],
    ids=["readings", "starts"],
)
def test_firehose_of_10_megabytes_per_second(
    fleet: FleetProcesses, tcp_car: TcpCar, gateway: GatewayProcess, nonsense: bytes
) -> None:
    before_mb = gateway.rss_mb()
    published = []
    fleet.bus.subscribe("fleet/red/frame/rx", lambda _: published.append(1))
    began = time.monotonic()
    assert tcp_car.pour(nonsense, 10 * MEGABYTE, 1.0) > 0
    asked_at, written = time.monotonic(), len(tcp_car.received)
    assert fleet.ask("stop", kind="person")["status"] in TAKEN
    assert time.monotonic() - asked_at < 2.0 + BUSY_S, "it answers in between"
    wait_for(lambda: len(tcp_car.received) > written, "a stop is written")
    assert gateway.rss_mb() < before_mb + BOUND_MB
    good_frame_counts(fleet, tcp_car.send)
    wait_for(lambda: fleet.state("link").rejects["raw_not_published"] > 1000, "it says how much was left out")
    assert len(published) < 1000 + 100 * (time.monotonic() - began) + 100, "the raw frames too are bounded"
    assert gateway.stderr.count("sends more bytes than any car") == 1
    assert gateway.popen.poll() is None
    assert "Traceback" not in gateway.stderr
