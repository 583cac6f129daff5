"""`gateway send` as a process: frames to a car, refused frames with reasons, and warnings about the car."""

import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.tools.send import why_not
from schemas.words import Mode
from tests.gateway.conftest import PATIENCE_S, Command
from tests.support.processes import TcpCar, driving, wait_for
from tests.support.text_parts import has_parts

STOP = "$0,0,0,0,0,0,0,0,0#"
RUN = "$1,0,0,0,0,0,0,0,0#"


def test_car_drives_until_it_is_stopped_as_it_says(simulate: Callable[..., Any], command: Command) -> None:
    sim, [link] = simulate("red:arduino:pty")
    wait_for(lambda: sim.say({"car": "red", "ask": "truth"})["mode"] == "manual", "the car has started")
    done = command("send", "--link", link, "--wait", "1", RUN)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"sent {RUN} to {link}",
        "cars do not answer; `gateway monitor` shows what the car sends",
        "in mode 0 it drives (forward) until the next command, even without a link",
        f"stop it: gateway send --link {link} '{STOP}'",
        f"     or: gateway send --link {link} '$4WD,MODE00#', which works in every mode, but not on a Raspberry Pi car",
    ]
    wait_for(lambda: driving(sim), "the car drives")
    done = command("send", "--link", link, STOP)
    assert "motors are off" in done.stdout
    wait_for(lambda: not driving(sim), "the car stands")


def test_mode_is_opened_and_closed_as_it_says(simulate: Callable[..., Any], command: Command) -> None:
    sim, [link] = simulate("red:arduino:pty")
    done = command("send", "--link", link, "--platform", "arduino", "--wait", "1", "$4WD,MODE21#")
    assert done.returncode == 0
    assert f": gateway send --link {link} '$4WD,MODE00#'" in done.stdout
    wait_for(lambda: sim.say({"car": "red", "ask": "truth"})["mode"] == "tracking", "the car tracks")
    assert command("send", "--link", link, "--wait", "4", "$4WD,MODE00#").returncode == 0
    wait_for(lambda: sim.say({"car": "red", "ask": "truth"})["mode"] == "manual", "the car is in mode 0")


@pytest.mark.parametrize(("where", "why"), [(">&-", "Bad file descriptor"), (">/dev/full", "No space left on device")])
def test_send_tells_how_to_stop_even_without_stdout(where: str, why: str, simulate: Callable[..., Any]) -> None:
    sim, [link] = simulate("red:arduino:pty")
    frame = [sys.executable, "-m", "gateway.cli", "send", "--link", link, "$1,0,0,0,0,0,0,0,0#"]
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {where}', "sh", *frame],
        stderr=subprocess.PIPE,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1
    first, *_, stop, _, last = done.stderr.splitlines()
    assert first == f"sent $1,0,0,0,0,0,0,0,0# to {link}"
    assert stop.endswith(f": gateway send --link {link} '$0,0,0,0,0,0,0,0,0#'")
    assert last.startswith("gateway send: ")
    assert last.endswith(f": {why}")
    wait_for(lambda: driving(sim), "it drives")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # A shell's expansion of '$0,...' and '$4WD,...' in double quotes.
        ("bash,0,1,0,0,0,0,0,0#", "in single quotes, '$0,0,1,0,0,0,0,0,0#'"),
        ("/usr/bin/zsh,0,1,0,0,0,0,0,0#", "in single quotes, '$0,0,1,0,0,0,0,0,0#'"),
        (",0,1,0,0,0,0,0,0", "in single quotes, '$<digit>,0,1,0,0,0,0,0,0#'"),
        ("WD,MODE00#", "in single quotes, '$4WD,MODE00#'"),
        ("stop", "begins with '$'"),
        ("$0,0,1,0,0,0,0,0,0", "'#': '$0,0,1,0,0,0,0,0,0#'?"),
        ("$0,0,1,0,0,0,0,0#", "8 of the nine"),
        ("$5,0,0,0,0,0,0,0,0#", "place 1 (motion) is '5', allowed are 0..4"),
        ("$0,0,1,7,0,0,0,0,0#", "place 4 (speed) is '7', allowed are 0..2"),
        ("$0,0,1,0,,0,0,0,0#", "place 5 (servo) is '', allowed are 0..8"),
        ("$0,0,0,0,1,0,0,0,1#", "(place 5) … (place 9)"),
        ("$4WD,PTZ181#", "the table"),
        ("$4WD,MODE01#", "mode 0 cannot be opened; '$4WD,MODE00#' closes"),
    ],
)
def test_why_a_text_is_no_frame(text: str, words: str) -> None:
    assert has_parts(why_not(text), words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bash,0,1,0,0,0,0,0,0#"], "single quotes"),
        (["$4WD,PTZ90#"], "unknown platform … pan/tilt frame"),
        (["$4WD,MODE21#", "--platform", "raspberry_pi"], "raspberry_pi cars … mode tracking"),
        (["#"], "lone '#'"),
        (["\u20ac"], "'\u20ac'"),
        (["", "--raw"], "frame '' is empty"),
        ([STOP, "--platform", "pi"], 'Unknown platform "pi"'),
        ([STOP, "--wait", "-1"], '--wait: "-1" … duration'),
        ([STOP, "--wait", "nan"], '--wait: "nan" … duration'),
        ([STOP, "--link", "ws://x"], "not a link"),
    ],
)
def test_send_refusals_open_no_link(command: Command, arguments: list[str], words: str) -> None:
    done = command("send", "--link", "/dev/nope", *arguments)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert has_parts(done.stderr, words)
    assert done.stdout == ""


def test_link_that_cannot_be_had_is_one_line(command: Command) -> None:
    done = command("send", "--link", "/dev/nope", STOP)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "no such port" in done.stderr


def test_unstoppable_tcp_car_is_not_started(command: Command) -> None:
    car = TcpCar()
    try:
        for more in ([], ["--platform", "raspberry_pi"]):
            done = command("send", "--link", car.link, *more, RUN)
            assert done.returncode == 2
            assert "dies" in done.stderr
        assert car.connections == 0
        done = command("send", "--link", car.link, STOP)
        assert done.returncode == 0
        assert "note: tcp://" in done.stderr
        assert command("send", "--link", car.link, "--platform", "arduino", RUN).returncode == 0
        assert command("send", "--link", car.link, "--raw", "$9,junk").returncode == 0
        wait_for(lambda: len(car.received) == 3, "all have come")
        assert car.received == [STOP.encode(), RUN.encode(), b"$9,junk"]
    finally:
        car.close()


@contextmanager
def bridge_in_use(words: bytes) -> Iterator[str]:
    """Serve one connection: say the words, end this side, and read until the client ends, too. Yield the link."""

    def refuse() -> None:
        peer, _ = listener.accept()
        with peer:
            peer.sendall(words)
            peer.shutdown(socket.SHUT_WR)
            while peer.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        refusing = pool.submit(refuse)
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        refusing.result()


@pytest.mark.parametrize("wait", [(), ("--wait", "10")])
def test_frame_to_a_bridge_that_is_in_use_is_not_said_to_be_sent(command: Command, wait: tuple[str, ...]) -> None:
    """ser2net accepts a second client, says that it has one, and closes. The frame reaches no car."""
    with bridge_in_use(b"Port already in use\r\n") as link:
        done = command("send", "--link", link, *wait, STOP)
    assert done.returncode == 1
    assert has_parts(done.stderr, 'said "Port already in use"')
    assert not done.stdout.startswith("sent ")
    assert has_parts(done.stdout, f"wrote {STOP} … perhaps it did not arrive") is not bool(wait)


def test_every_mode_has_its_words(command: Command) -> None:
    from gateway.drivers.yahboom.protocol.frames import ModeOpen
    from gateway.tools.send import aftermath

    for mode in set(Mode) - {Mode.MANUAL}:
        words = "\n".join(aftermath(ModeOpen(mode), parse_platform("arduino"), "/dev/my port"))
        assert f"opening mode {mode}" in words
        assert "gateway send --link '/dev/my port' '$4WD,MODE00#'" in words
