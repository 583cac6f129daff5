"""What a wrong baud rate makes of a car's report, and what the gateway says then."""

from pathlib import Path

import pytest

from gateway.link import LinkUrl, parse_url
from gateway.link.baud import MIN_BYTES, BaudWatch
from gateway.sim.model.line_rate import misread
from tests.gateway.link.peers import PtyPeer
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

REPORT = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"
LINK = parse_url("/dev/ttyUSB0")


def doubt(data: bytes, url: LinkUrl = LINK) -> tuple[str, str] | None:
    watch = BaudWatch(url)
    found = [each for at in range(0, len(data), 7) if (each := watch.on_bytes(data[at : at + 7])) is not None]
    assert len(found) <= 1, "it is said once"
    return (found[0].cause, found[0].words) if found else None


def test_baud_detection_reads_line_at_right_rate() -> None:
    assert misread(REPORT, sent_at=9600, read_at=9600) == REPORT


@pytest.mark.parametrize("rate", [38400, 57600, 115200])
def test_port_that_is_too_fast_is_recognized(rate: int) -> None:
    data = misread(REPORT * 10, sent_at=9600, read_at=rate)
    found = doubt(data, parse_url(f"serial:///dev/ttyUSB0?baud={rate}"))
    assert found is not None
    assert found[0] == "wrong_baud"
    assert f" {rate} baud: " in found[1]
    assert found[1].endswith(" 9600.")


@pytest.mark.parametrize(("car", "port"), [(115200, 9600), (57600, 9600), (9600, 4800), (9600, 19200)])
def test_other_wrong_rates_are_doubted(car: int, port: int) -> None:
    data = misread(REPORT * 100, sent_at=car, read_at=port)
    found = doubt(data, parse_url(f"serial:///dev/ttyUSB0?baud={port}"))
    assert found is not None
    assert found[0] == "no_frames"
    assert f" {port} baud" in found[1]


def test_bytes_that_people_see() -> None:
    for url, words in (
        ("/dev/ttyUSB0", "The port is at 9600 baud: does this car use another one (?baud=115200)?"),
        ("serial://?vid=1a86&baud=57600", "The port is at 57600 baud: cars use 9600."),
        ("tcp://bridge:4000", "Is the bridge at the baud rate of the car, 9600?"),
        ("ble://name=BT04", "Is the module at the baud rate of the car, 9600?"),
    ):
        found = doubt(bytes.fromhex("0080E0F8FE") * 60, parse_url(url))
        assert found is not None
        assert found[1].startswith("203 bytes came, ")
        assert found[1].endswith(f" {words}")


def test_baud_detection_trusts_text_few_bytes_and_frames() -> None:
    assert doubt(b"EXEC:F\r\n" * 100) is None, "a car without readings that prints lines"
    assert doubt(bytes(MIN_BYTES - 1)) is None
    watch = BaudWatch(LINK)
    watch.on_frame()
    assert watch.on_bytes(bytes(10 * MIN_BYTES)) is None, "noise on a line that works"


def test_line_of_text_between_frames_is_no_damage(tmp_path: Path) -> None:
    """Some programs print a line after each general frame."""
    peer = PtyPeer(tmp_path)
    started = FleetProcesses(free_endpoint(), tmp_path)
    try:
        gateway = started.gateway(str(peer.url))
        wait_for(lambda: "[link_open]" in gateway.stderr, "the port is open")
        lines = REPORT + b"EXEC:F\r\n" + REPORT + b"speed 120\r\nok\r\n"
        peer.send(lines + REPORT + REPORT[1:] + lines + REPORT + bytes.fromhex("0180FF") + REPORT)
        wait_for(lambda: (link := started.state("link")) and link.rx_frames == 9, "all have come")
        assert dict(started.state("link").rejects) == {"text": 6, "no_start": 2}, "a frame without its $ is damage"
    finally:
        started.close()
        peer.close()


def test_gateway_says_it(tmp_path: Path) -> None:
    peer = PtyPeer(tmp_path)
    started = FleetProcesses(free_endpoint(), tmp_path)
    try:
        gateway = started.gateway(f"{peer.url}?baud=115200")
        wait_for(lambda: "[link_open]" in gateway.stderr, "the port is open")
        peer.send(misread(REPORT * 10, sent_at=9600, read_at=115200))
        wait_for(lambda: (link := started.state("link")) and link.rejects["wrong_baud"] == 1, "it is counted")
        wait_for(lambda: "The port is at 115200 baud: cars use 9600. [no_frames]" in gateway.stderr, "it is said")
    finally:
        started.close()
        peer.close()
