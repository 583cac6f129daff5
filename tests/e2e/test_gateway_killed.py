"""SIGKILL of a gateway, or its link cut, while its car drives: the claims meanwhile, and the stop of the car.

The simulator's truth is the judge, with its own stamps. tests/soak/test_kills.py repeats it with strict limits.
"""

import signal
from pathlib import Path

import pytest

from fleet.client.client import Fleet as Client
from tests.support.judge import Judge
from tests.support.kills import BUSY_S, cut_links
from tests.support.ports import free_port
from tests.support.processes import FleetProcesses, TcpCar, driving, wait_for


@pytest.mark.soak
def test_restored_link_stops_car_at_once(fleet: FleetProcesses, tmp_path: Path) -> None:
    found = cut_links(fleet, tmp_path)
    late = {what: str(took) for what, took in found.items() if took.took_s > took.limit_s + BUSY_S}
    assert not late, late


def test_raspberry_pi_car_of_killed_gateway_drives_on_and_is_told(fleet: FleetProcesses) -> None:
    """The car's program dies with its client. No gateway can stop the car, and none claims that it stands.

    See docs/reference/protocol.md#hazards-of-raspberry-pi-programs.
    """
    judge = Judge.follow(fleet.bus)
    sim, (link,) = fleet.simulate("red:raspberry_pi:tcp", truth=True)
    gateway = fleet.gateway(link, platform="raspberry_pi")
    fleet.ready()
    fleet.ask("drive", motion="forward", duration_s=10)
    wait_for(lambda: judge.driving, "it drives")
    gateway.kill()
    with Client(fleet.endpoint, sender="mia", kind="person") as client:
        wait_for(lambda: not client.cars(), "its gateway is gone")
        outcome = client.car("red").stop()
        assert not outcome.ok
        assert outcome.words.startswith("NOT STOPPED: ")
        assert '"red"' in outcome.words
    words = "the car may be driving"
    wait_for(lambda: not sim.say({"car": "red", "ask": "truth"})["alive"], "its program has died")
    again = fleet.gateway(link, platform="raspberry_pi")
    assert again.wait() == 1
    assert words in again.stderr
    fleet.gateway(link, "--retry", platform="raspberry_pi")
    wait_for(lambda: (state := fleet.state("link")) and state.state == "lost" and words in state.reason, "the same")
    assert fleet.state("safety").motors == "unknown"
    assert fleet.state("motion").motion == "unknown"
    answer = fleet.ask("stop", sender="mia", kind="person")
    assert (answer["status"], answer["reason"]) == ("rejected", "link_down")
    assert answer["words"].startswith("NOT STOPPED: red ")
    assert judge.driving


def test_gateway_without_hub_stops_car(fleet: FleetProcesses, tmp_path: Path) -> None:
    """The network is away. The watchdog has ended a gateway whose car drives, and its successor starts."""
    sim, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    gateway = fleet.gateway(link)
    fleet.ready()
    fleet.ask("drive", motion="forward", duration_s=10)
    wait_for(lambda: driving(sim), "it drives")
    gateway.kill()
    assert driving(sim)
    successor = fleet.start(
        "-m", "gateway.cli", "run", "--car", "red", "--link", link, "--platform", "arduino", "--retry",
        "--connect", f"tcp/192.0.2.1:{free_port()}", "--state-dir", str(tmp_path / "state"),
    )  # fmt: skip
    assert successor.wait() == 1
    assert not driving(sim)
    assert "red was stopped" in successor.stderr


def test_ctrl_c_waits_for_stop_without_hub(fleet: FleetProcesses) -> None:
    car = TcpCar()
    try:
        alone = fleet.start(
            "-m", "gateway.cli", "run", "--car", "red", "--link", car.link, "--platform", "arduino",
            "--connect", f"tcp/192.0.2.1:{free_port()}",
        )  # fmt: skip
        wait_for(lambda: car.received, "the stop has begun")
        alone.popen.send_signal(signal.SIGINT)
        car.obey()
        assert alone.wait() == 130
        assert "red was stopped" in alone.stderr
    finally:
        car.close()


def test_gateway_that_finds_neither_hub_nor_car_says_both(fleet: FleetProcesses) -> None:
    alone = fleet.start(
        "-m", "gateway.cli", "run", "--car", "red", "--link", f"tcp://127.0.0.1:{free_port()}", "--platform",
        "arduino", "--connect", f"tcp/192.0.2.1:{free_port()}",
    )  # fmt: skip
    assert alone.wait() == 1
    assert "red may be moving, and was not stopped" in alone.stderr
